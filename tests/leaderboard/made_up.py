"""Made-up records for tests that need no simulator."""

from leaderboard.entry import Entry
from leaderboard.plan import plan_episodes
from leaderboard.protocol import protocol_name
from leaderboard.records import EpisodeRecord
from sacil_tasks.catalog import task_names
from sacil_tasks.splits import SPLITS

PROTOCOL = "0123456789ab"


def make_entry(agent: str = "toy", checkpoint: str | None = None) -> Entry:
    names = {protocol_name(task, split) for task in task_names() for split in SPLITS}
    protocols = dict.fromkeys(names, PROTOCOL)
    return Entry(agent=agent, privileged=False, checkpoint=checkpoint, protocols=protocols)


def make_records(
    task: str = "pick_and_lift", episodes: int = 6, split: str = "canon", **changes
) -> list[EpisodeRecord]:
    """Records of a task in which every word was obeyed, unless `changes` say otherwise."""
    entry = make_entry()
    records = []
    for key in plan_episodes([(task, split)], "val", 0, episodes):
        asked = tuple(entry.identity(key)["slots"].values())
        result = {
            "outcome": "SUCCESS",
            "success": True,
            "success_lenient": True,
            "asked": asked,
            "handled": asked,
            "end": "success",
            "keyframes": 4,
        }
        records.append(EpisodeRecord(**(entry.identity(key) | result | changes)))
    return records
