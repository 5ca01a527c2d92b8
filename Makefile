# make book        set up, run the chapters on the demo profile, render the book
# make test        set up, then lint, unit tests, all chapters on the smoke profile, and checks of what came out
# make notebooks   make book, then renew the executed notebooks stored in notebooks/
# make weights     train a network of data/weights/recipe.yaml (NETWORK=rol) and put its weights into data/weights
# make judge       judge the weights of a network (NETWORK=rol) again and compare with their card
# make real        clone the public repositories with the small pieces of real data into data/real
# make clean       remove everything made by the above but .venv, data/real and the sessions that networks learn from
#
# Nothing is needed but Python 3.11 or 3.12, make and git; everything is installed into .venv.

SHELL := bash
.SHELLFLAGS := -eu -o pipefail -c
.DEFAULT_GOAL := help
.PHONY: help setup book test notebooks weights judge real lint format clean

# UTF-8 whatever the locale is, also in the tools that are called.
export PYTHONUTF8 := 1
BIN := .venv/bin
# The stamp's name is the sum of what is installed, so a changed lock file asks for another stamp.
STAMP := .venv/set-up-$(shell cat requirements.lock pyproject.toml | cksum | cut -d ' ' -f 1)
CORES ?= $(shell nproc 2>/dev/null || sysctl -n hw.ncpu)
PROFILE ?= demo
NETWORK ?= rol
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

test: $(STAMP) lint
	@mkdir -p build/test
	@$(PYTEST) -n $(CORES) --ignore=tests/notebooks | tee build/test/unit.log
	@$(MAKE) --no-print-directory book PROFILE=smoke
	@$(PYTEST) -n $(CORES) --dist loadfile tests/notebooks | tee build/test/book.log
	@echo
	@echo "Tested: ruff on src, workflow, tests and notebooks;"
	@echo "all chapters on the smoke profile by papermill ($$(find build/smoke/notebooks -name '*.ipynb' | wc -l) runs) and their book;"
	@echo "the stored notebooks, the runs and the built book: $$(tail -n 1 build/test/book.log)"
	@echo "every module by itself (unit tests):"
	@tail -n 1 build/test/unit.log

notebooks: book
	@$(BIN)/python workflow/renew_notebooks.py config/demo.yaml

weights: $(STAMP)
	@OMP_WAIT_POLICY=PASSIVE $(BIN)/python workflow/train_weights.py data/weights/recipe.yaml $(NETWORK) --threads $(CORES)

judge: $(STAMP)
	@OMP_WAIT_POLICY=PASSIVE $(BIN)/python workflow/train_weights.py data/weights/recipe.yaml $(NETWORK) --threads $(CORES) --judge

real:
	@mkdir -p data/real
	@for repository in ZJUYH/RaLL Samleo8/RadarSLAMPy marcelsheeny/radiate_sdk; do \
	    folder=data/real/$${repository#*/}; \
	    if [ -d "$$folder" ]; then echo "$$folder is there"; continue; fi; \
	    rm -rf "$$folder.part"; \
	    git clone --depth 1 "https://github.com/$$repository.git" "$$folder.part"; \
	    mv "$$folder.part" "$$folder"; \
	done

lint: $(STAMP)
	@$(BIN)/ruff check
	@$(BIN)/ruff format --check

format: $(STAMP)
	@$(BIN)/ruff check --fix
	@$(BIN)/ruff format

clean:
	@rm -rf build .snakemake .pytest_cache .ruff_cache data/sessions/demo data/sessions/smoke data/sessions/route
	@echo "Kept: .venv, data/real, data/sessions/weights, and sessions of your own."
