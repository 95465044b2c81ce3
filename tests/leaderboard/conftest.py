from pathlib import Path

import pytest
from made_up import make_records

from leaderboard.records import EpisodeLog


@pytest.fixture
def run_folder(tmp_path: Path) -> Path:
    """A folder with six episodes."""
    with EpisodeLog(tmp_path) as log:
        for record in make_records():
            log.append(record)
    return tmp_path
