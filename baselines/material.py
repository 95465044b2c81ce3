"""What a run is made from: data, embeddings of its sentences, and a network of the right shape."""

import logging
from dataclasses import dataclass
from functools import partial
from pathlib import Path

import torch

from baselines.agent import find_agent
from baselines.checkpoint import Identity
from baselines.distributed import first_rank_first, own_device, rank, share
from baselines.loader import Loader
from baselines.options import Job
from baselines.run import Validator
from baselines.samples import KeyframeSet
from baselines.scene.sight import Sight
from baselines.text import SentenceTable, cached_table
from baselines.trainer import Trainer
from baselines.validate import validate
from sacil_tasks.catalog import task_spec
from sacil_tasks.instructions import official_sentences

SPLIT = "canon"

log = logging.getLogger(__name__)


@dataclass(frozen=True)
class Material:
    """What a run is made from: the job, its data and the embeddings of its sentences."""

    job: Job
    identity: Identity
    keyframes: KeyframeSet
    text: SentenceTable
    device: torch.device

    @classmethod
    def load(cls, job: Job) -> "Material":
        """Read the keyframe files.

        Raises:
            UsageError: files are missing or damaged, the text encoder is needed but missing, or
                batches or GPUs cannot be shared by the processes.
        """
        options = job.options
        share(job.config.recipe.batch)
        device = own_device(options.device)
        keyframes = KeyframeSet.load(_keyframes(options.data, "train"), options.chosen_tasks)
        with first_rank_first():  # sentences are embedded once
            text = cached_table(job.config.recipe.text, sentences_of(keyframes))
        spec, variant = find_agent(options.agent)
        identity = Identity(
            agent=spec.name,
            variant=variant,
            preset=options.preset,
            tasks=keyframes.tasks,
            text=text.spec,
            config=job.config,
        )
        return cls(job, identity, keyframes, text, device)

    def trainer(self, steps: int) -> Trainer:
        """A trainer at step 0; the same every time."""
        seed = self.job.options.seed
        torch.manual_seed(seed)
        network = self.identity.create()
        network.load_pretrained()
        network.to(self.device)
        loader = Loader(
            self.keyframes,
            self.text,
            sight=network.sight,
            recipe=self.job.config.recipe,
            seed=seed,
            goal_sight=network.goal_sight,
        )
        return Trainer(network, loader, self.job.config.recipe, steps=steps, seed=seed)

    def validator(self, sight: Sight) -> Validator | None:
        """Scores on the `val` demos of these tasks, or None where there are none.

        The first rank alone validates.
        """
        if rank() > 0:
            return None
        folder = _keyframes(self.job.options.data, "val")
        tasks = [task for task in self.keyframes.tasks if (folder / f"{task}.h5").is_file()]
        if not tasks:
            log.info("no validation: no keyframes in %s", folder)
            return None
        held_out = KeyframeSet.load(folder, tasks)
        recipe = self.job.config.recipe
        loader = Loader(
            held_out,
            cached_table(recipe.text, sentences_of(held_out)),
            sight=sight,
            recipe=recipe,
            seed=0,
        )
        return partial(validate, loader=loader)


def _keyframes(data: Path, partition: str) -> Path:
    return data / SPLIT / partition / "keyframes"


def sentences_of(keyframes: KeyframeSet) -> dict[Path, set[str]]:
    """The sentences of each keyframe file, and all official ones of its task."""
    return {
        shard.path: {e.instruction for e in shard.episodes}
        | set(official_sentences(task_spec(shard.task)))
        for shard in keyframes.shards
    }
