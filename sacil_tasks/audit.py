"""Prove that size is the only cue, and that the tasks can be done: `python -m sacil_tasks.audit`.

oracles    a policy that knows trained sizes is right in every `canon` scene and in exactly a third
           of the shifted ones; one that goes by rank is always right
shortcuts  nothing that is no image tells the named candidate: place, colour, segmentation id, actor
           name, text, info; and no scene is solved from the start
looks      other words, the same pixels; every two sizes can be told apart in two views or more
scripts    mistakes made on purpose get the outcome code meant for them
expert     how often the motion planner succeeds, by task, split and size

Finished trials are kept in OUT, so the same command resumes. Exit code 0 only if all holds.
"""

import csv
import json
import os
import sys
from collections import defaultdict
from collections.abc import Iterator, Sequence
from contextlib import closing
from dataclasses import astuple, dataclass, fields
from functools import cache
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal, TypeAlias

import tyro
from tqdm import tqdm

from sacil_tasks import verdicts
from sacil_tasks.catalog import suite_tasks, task_spec
from sacil_tasks.errors import UsageError, run_command
from sacil_tasks.files import atomic_path, content_hash, file_sha256
from sacil_tasks.verdicts import Finding
from sacil_tasks.workers import JobFailure, run_jobs

if TYPE_CHECKING:
    from sacil_tasks.trials import Trial
