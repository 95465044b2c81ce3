"""Size-sensitive manipulation tasks for ManiSkill 3.

Importing this package registers the gymnasium ids (`gym.make("sacil_tasks:SizedPickAndLift-v1")`);
torch and ManiSkill are imported when an environment is made.
"""

from gymnasium.envs.registration import WrapperSpec, register, registry

from sacil_tasks.catalog import MAX_EPISODE_STEPS, entry_point, env_id, task_names

for _task in task_names():
    register(
        env_id(_task),
        entry_point=entry_point(_task),
        max_episode_steps=MAX_EPISODE_STEPS,
        disable_env_checker=True,  # it rejects the empty observation space of obs_mode="none"
        additional_wrappers=(
            WrapperSpec(
                "MSTimeLimit",
                entry_point="mani_skill.utils.registration:TimeLimitWrapper",
                kwargs={"max_episode_steps": MAX_EPISODE_STEPS},
            ),
        ),
    )
    # Recordings name it, and whoever replays them in another process must import this package.
    registry[env_id(_task)].id = f"{__name__}:{env_id(_task)}"
