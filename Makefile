# Every verb works from a fresh clone: the environment is made, and made anew only when pyproject.toml changes.

.DEFAULT_GOAL := help
.PHONY: help demo test lint bench picture clean
.DELETE_ON_ERROR:

# The first interpreter that runs, is new enough and can make an environment; override with PYTHON=/path/to/python.
PROBE := import ensurepip, sys; sys.exit(sys.version_info < (3, 11))
PYTHON = $(shell for candidate in python3 python3.13 python3.12 python3.11; do \
	"$$candidate" -c '$(PROBE)' 2>/dev/null && { echo "$$candidate"; break; }; done)
RUN := .venv/bin/python
OUT := out/demo

help: ## list the verbs
	@awk -F ':.*## ' '/^[a-z]+:.*## / { printf "make %-8s %s\n", $$1, $$2 }' Makefile

demo: .venv/demo.stamp ## render the built-in scenes on simulated devices into out/demo
	@.venv/bin/hapticrender demo --out $(OUT)

test: .venv/test.stamp ## run every test (PYTEST_ARGS="-m 'not slow'" leaves out the long ones)
	@MPLBACKEND=Agg $(RUN) -m pytest $(PYTEST_ARGS)

lint: .venv/test.stamp ## check style, formatting and types
	@$(RUN) -m ruff check .
	@$(RUN) -m ruff format --check .
	@$(RUN) -m mypy

bench: .venv/bench.stamp ## measure every figure of speed beside its target (BENCH_ARGS="--short" as CI does)
	@$(RUN) benchmarks/run.py $(BENCH_ARGS)

picture: .venv/demo.stamp ## draw the pictures in README.md anew
	@.venv/bin/hapticrender chart story --out out/chart
	@.venv/bin/hapticrender chart pareto --out out/chart
	@cp out/chart/story.png docs/picture.png
	@cp out/chart/pareto.png docs/pareto.png

clean: ## remove the environment and everything that was built or written
	@rm -rf .venv build dist out *.egg-info .pytest_cache .mypy_cache .ruff_cache .hypothesis
	@find . -name __pycache__ -type d -prune -exec rm -rf {} +

.venv/made.stamp:
	@test -n "$(PYTHON)" || { echo "hapticrender needs Python >= 3.11 with the venv module; none of python3, python3.13, python3.12, python3.11 is one" >&2; exit 1; }
	@"$(PYTHON)" -m venv .venv
	@touch $@

.venv/demo.stamp: .venv/made.stamp pyproject.toml
	@echo "installing hapticrender into .venv"
	@$(RUN) -m pip install --quiet --disable-pip-version-check --editable '.[all]'
	@touch $@

.venv/test.stamp: .venv/made.stamp pyproject.toml
	@echo "installing hapticrender and its test tools into .venv"
	@$(RUN) -m pip install --quiet --disable-pip-version-check --editable '.[all,test]'
	@touch $@ .venv/demo.stamp

.venv/bench.stamp: .venv/test.stamp
	@echo "installing what the benchmarks compare with into .venv"
	@$(RUN) -m pip install --quiet --disable-pip-version-check --editable '.[all,test,bench]'
	@touch $@
