"""How fast does an agent train? Whole steps: loading, views, losses, optimiser.

    python benchmarks/bench_training.py --agent sacil --data data [--recipe.precision bf16 ...]

Takes the flags of `baselines.train` (`--steps` says how many steps are timed) and writes nothing
but the embeddings into the keyframe files. Medians over steps; the first two, which compile, are
left out. A loaded machine shows in samples a second, not in samples a core-second.
"""

import resource
import statistics
import sys
import time

import torch

from baselines.material import Material
from baselines.options import Job, parse
from sacil_tasks.errors import run_command

WARM_UP = 2
STEPS = 20


def main(job: Job) -> None:
    """Time the steps and print one line a figure."""
    torch.set_num_threads(job.options.threads)
    trainer = Material.load(job).trainer(sys.maxsize)
    batch, steps = job.config.recipe.batch, job.options.steps or STEPS
    wall_s, core_s, shares = [], [], []
    for _ in range(WARM_UP + steps):
        wall, core = time.perf_counter(), time.process_time()
        parts = trainer.advance()
        wall_s.append(time.perf_counter() - wall)
        core_s.append(time.process_time() - core)
        shares.append({n: s / wall_s[-1] for n, s in parts.items() if n.startswith("seconds_")})
    parameters = sum(p.numel() for p in trainer.network.parameters())
    peak_gib = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 2**20
    print(f"{job.options.agent} {job.options.preset}: {parameters:,} parameters, batch {batch}")
    print(f"  samples a second       {batch / statistics.median(wall_s[WARM_UP:]):8.1f}")
    print(f"  samples a core-second  {batch / statistics.median(core_s[WARM_UP:]):8.1f}")
    for name in shares[0]:
        share = statistics.median(step[name] for step in shares[WARM_UP:])
        print(f"  {name.replace('seconds_', 'share of '):<22} {share:8.1%}")
    print(f"  peak memory            {peak_gib:8.2f} GiB")


if __name__ == "__main__":
    run_command(lambda: main(parse(sys.argv[1:])))
