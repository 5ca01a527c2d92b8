# make book        set up, run the chapters on the demo profile, render the book
# make test        set up, then lint, unit tests, all chapters on the smoke profile, and checks of what came out
# make check       compare the numbers of a build with the reference (PROFILE=demo; RUN=.../metrics.json: one rerun)
# make notebooks   make book, then renew the executed notebooks stored in notebooks/
# make weights     train a network of data/weights/recipe.yaml (NETWORK=unet) and put its weights into data/weights
# make judge       judge the weights of a network (NETWORK=unet) again and compare with their card
# make real        fetch the small pieces of real data from public repositories into data/real (CHECK=1: only check them)
# make seq01       the paper's Seq01 from the public radar images to Tables II and III (SESSION=folder: raw scans instead)
# make pdf         the built book as one PDF, build/<profile>/radar_on_lidar.pdf; needs Chromium, after make book
# make archive     one zip of code, executed notebooks, book and results with an RO-Crate, after make book
# make clean       remove everything made by the above but .venv, data/real and the sessions that networks learn from
#
# README.md names what the system must have; everything else is installed into .venv.

SHELL := bash
.SHELLFLAGS := -eu -o pipefail -c
.DEFAULT_GOAL := help
.PHONY: help setup book test check notebooks weights judge real seq01 pdf archive lint format clean

# UTF-8 whatever the locale is, also in the tools that are called.
export PYTHONUTF8 := 1
BIN := .venv/bin
# The stamp's name is the sum of what is installed, so a changed lock file asks for another stamp.
STAMP := .venv/set-up-$(shell cat requirements.lock pyproject.toml | cksum | cut -d ' ' -f 1)
CORES ?= $(shell nproc 2>/dev/null || sysctl -n hw.ncpu)
PROFILE ?= demo
NETWORK ?= unet
SNAKEMAKE = $(BIN)/snakemake --configfile config/$(PROFILE).yaml --cores $(CORES)
PYTEST = MPLBACKEND=Agg OMP_NUM_THREADS=1 OMP_WAIT_POLICY=PASSIVE $(BIN)/python -m pytest

help:
	@sed -n 's/^# \(make .*\)/\1/p' Makefile

setup: $(STAMP)

$(STAMP):
	@workflow/set_up.sh .venv $@

book: $(STAMP)
	@time $(SNAKEMAKE) book --nolock --prioritize pix2pix --rerun-incomplete --retries 1 --scheduler greedy --quiet host reason
	@echo "The book: $$($(BIN)/python workflow/stage_book.py --where config/$(PROFILE).yaml) (open it in a browser, no network needed)"
	@if [ -e data/reference/$(PROFILE).json ]; then $(BIN)/python workflow/check.py config/$(PROFILE).yaml || true; fi

test: $(STAMP) lint
	@mkdir -p build/test
	@$(PYTEST) -n $(CORES) --dist worksteal --ignore=tests/notebooks | tee build/test/unit.log
	@$(MAKE) --no-print-directory book PROFILE=smoke
	@$(PYTEST) -n $(CORES) --dist loadfile tests/notebooks | tee build/test/book.log
	@echo
	@echo "Tested: ruff on src, workflow, tests and notebooks;"
	@echo "all chapters on the smoke profile by papermill ($$(find build/smoke/notebooks -name '*.ipynb' | wc -l) runs) and their book;"
	@echo "the stored notebooks, the runs and the built book: $$(tail -n 1 build/test/book.log)"
	@echo "every module by itself (unit tests):"
	@tail -n 1 build/test/unit.log

check: $(STAMP)
	@$(BIN)/python workflow/check.py config/$(PROFILE).yaml $(if $(RUN),--run "$(RUN)")

notebooks: book
	@$(BIN)/python workflow/renew_notebooks.py config/demo.yaml
	@$(BIN)/python workflow/check.py --renew config/demo.yaml

weights: $(STAMP)
	@OMP_WAIT_POLICY=PASSIVE $(BIN)/python workflow/train_weights.py data/weights/recipe.yaml $(NETWORK) --threads $(CORES)

judge: $(STAMP)
	@OMP_WAIT_POLICY=PASSIVE $(BIN)/python workflow/train_weights.py data/weights/recipe.yaml $(NETWORK) --threads $(CORES) --judge

real: $(STAMP)
	@$(BIN)/python workflow/get_real.py $(if $(CHECK),--check)

seq01: $(STAMP)
	@OMP_WAIT_POLICY=PASSIVE $(BIN)/python -m rol_study.seq01 $(if $(SESSION),--session "$(SESSION)")

pdf: $(STAMP)
	@$(BIN)/python workflow/print_book.py config/$(PROFILE).yaml

archive: $(STAMP)
	@$(BIN)/python workflow/archive.py config/$(PROFILE).yaml

lint: $(STAMP)
	@$(BIN)/ruff check
	@$(BIN)/ruff format --check

format: $(STAMP)
	@$(BIN)/ruff check --fix
	@$(BIN)/ruff format

clean:
	@rm -rf build .snakemake .pytest_cache .ruff_cache
	@for code in data/sessions/{demo,smoke,route}/*.code; do \
	    made="$${code%.code}"; \
	    if [ -f "$$code" ]; then rm -rf "$$made" "$$made.log" "$$code"; fi; \
	done
	@echo "Kept: .venv, data/real, data/sessions/weights, and sessions of your own."
