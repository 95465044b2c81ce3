# Each target sets the machine up first; once that is done it costs nothing.

PYTHON := .venv/bin/python
WORKERS ?= $(shell n=$$(env -u OMP_NUM_THREADS nproc); echo $$((n < 8 ? n : 8)))
AGENT ?= sacil
export OMP_NUM_THREADS = 1

.DEFAULT_GOAL := help
.PHONY: help setup leaderboard test demos train cards doctor clean

help: ## this list
	@awk -F ':.*## ' '/^[a-z]+:.*## / { printf "make %-12s %s\n", $$1, $$2 }' $(MAKEFILE_LIST)

setup: ## .venv with the tested packages, and software Vulkan where no GPU renders
	@.ci/setup

leaderboard: setup ## evaluate the released SACIL checkpoint: 3 tasks x 25 episodes, CSV and table
	@$(PYTHON) -m sacil_tasks.doctor --quick
	@$(PYTHON) -m leaderboard.run --agent $(AGENT) --suite slice --episodes 25 --workers $(WORKERS)

test: setup ## style, types and all tests
	@$(PYTHON) -m ruff check .
	@$(PYTHON) -m ruff format --check .
	@$(PYTHON) -m mypy
	@$(PYTHON) -m pytest --numprocesses $(WORKERS) --dist loadfile

demos: setup ## 100 expert demonstrations of each of the nine tasks, and 36 for validation, into data/
	@$(PYTHON) -m sacil_tasks.gen_demos --suite all --demos 100 --workers $(WORKERS)
	@$(PYTHON) -m sacil_tasks.gen_demos --suite all --demos 36 --partition val --workers $(WORKERS)

train: setup ## train AGENT (sacil) on data/, cpu preset
	@$(PYTHON) -m baselines.train --agent $(AGENT) --suite slice

cards: setup ## docs/tasks/ and the README's pictures, after a change to a task
	@$(PYTHON) -m sacil_tasks.cards

doctor: setup ## is this machine able, and what to do if not
	@$(PYTHON) -m sacil_tasks.doctor

clean: ## remove .venv and caches; data/, runs/ and report/ stay
	rm -rf .venv .mypy_cache .pytest_cache .ruff_cache .hypothesis *.egg-info
