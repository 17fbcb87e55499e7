# Every verb works from a fresh clone: the environment is made, and made anew only when pyproject.toml changes.

.DEFAULT_GOAL := help
.PHONY: help demo test packages audio-test board-test test-oldest lint bench charts paper docs wheel clean
.DELETE_ON_ERROR:

# The first interpreter that runs, is new enough and can make an environment; override with PYTHON=/path/to/python.
PROBE := import ensurepip, sys; sys.exit(sys.version_info < (3, 11))
PYTHON = $(shell for candidate in python3 python3.13 python3.12 python3.11; do \
	"$$candidate" -c '$(PROBE)' 2>/dev/null && { echo "$$candidate"; break; }; done)
RUN := .venv/bin/python
# On the path itself: a folder of the name `hapticrender`, as a clone has, would else be the package for scripts beside it.
INSTALL := $(RUN) -m pip install --quiet --disable-pip-version-check --config-settings editable_mode=compat --editable
OUT := out/demo
OLDEST = $(shell sed -n 's/^dependencies = \[\(.*\)\]/\1/p' pyproject.toml | tr -d '",' | sed 's/>=/==/g')
OLDEST_TESTS := $(addprefix tests/test_,$(addsuffix .py,math kernel blocks plate contact low_pass realtime))
# Tests that play in real time come last, when all is compiled and nothing else runs: a machine that has other work loses
# samples, and JACK now and then a wake-up.  What fails of them is run once more, one after the other, and that is said;
# what a crash of PortAudio interrupts (docs/realtime.md) is played again by another worker.
REAL_TIME := $(addprefix tests/test_,audio_friction.py audio_jack.py player_board.py player_clock.py player_foreseen.py board_live.py board_profile.py audio_carrier.py)
IN_REAL_TIME := MPLBACKEND=Agg $(RUN) -m pytest $(REAL_TIME) --dist loadfile -o cache_dir=build/real_time
PACKAGES := jackd2 libportaudio2 libjack-jackd2-dev gcc libc6-dev make gcc-arm-none-eabi libnewlib-arm-none-eabi qemu-system-arm
BOARD_TESTS := $(addprefix tests/test_,firmware_law.py firmware_screen.py firmware_m4.py export.py protocol.py serial_driver.py board_faults.py board_live.py board_profile.py board_textures.py \
	nu32.py player_board.py)
API := hapticrender $(addprefix hapticrender.,loop latency sweep realtime_entry validate protocols bands errors touch recordings analysis \
	control plants renderers drivers)

help: ## list the verbs
	@awk -F ':.*## ' '/^[a-z-]+:.*## / { printf "make %-12s %s\n", $$1, $$2 }' Makefile

demo: .venv/demo.stamp ## render the built-in scenes on simulated devices into out/demo
	@.venv/bin/hapticrender demo --out $(OUT)

test: .venv/test.stamp ## run every test (PYTEST_ARGS="-m 'not slow'" leaves out the long ones)
	@rm -rf build/real_time
	@MPLBACKEND=Agg $(RUN) -m pytest -n 2 --dist worksteal $(addprefix --ignore=,$(REAL_TIME)) $(PYTEST_ARGS) \
		|| test $$? = 5  # nothing selected
	@$(IN_REAL_TIME) -n 2 $(PYTEST_ARGS) --maxfail=0 || case $$? in 5) ;; \
		1) echo "repeated, as they failed in real time:"; \
			$(IN_REAL_TIME) -n 1 --last-failed --last-failed-no-failures none $(PYTEST_ARGS) || test $$? = 5;; \
		*) false;; esac

# Tests of what is missing are skipped, and say so.
packages: ## install what the tests of sound cards and boards need (on Debian and Ubuntu, as root)
	@if ! dpkg -s $(PACKAGES) >/dev/null 2>&1; then if [ "$$(id -u)" = 0 ] && command -v apt-get >/dev/null; then \
		echo "installing $(PACKAGES)"; apt-get update -qq; \
		DEBIAN_FRONTEND=noninteractive apt-get install -qq -y --no-install-recommends $(PACKAGES) >/dev/null \
		|| echo "not all could be installed: tests of what is missing are skipped" >&2; \
		else echo "tests of sound cards or boards are skipped; to run them: sudo apt-get install $(PACKAGES)" >&2; fi; fi

audio-test: .venv/test.stamp packages ## run the sound-card driver on a JACK server, with a plate behind it
	@$(RUN) -m pytest -rs $(wildcard tests/test_audio*.py) $(PYTEST_ARGS)

board-test: .venv/test.stamp packages ## run the firmware's tests, on an emulated Cortex-M4 too
	@$(RUN) -m pytest -rs $(BOARD_TESTS) $(PYTEST_ARGS)

test-oldest: .venv-oldest/made.stamp ## run the kernels' tests on the oldest numba, numpy and scipy that pyproject.toml allows
	@MPLBACKEND=Agg .venv-oldest/bin/python -m pytest $(wildcard $(OLDEST_TESTS)) $(PYTEST_ARGS)

lint: .venv/test.stamp ## check style, formatting and types
	@$(RUN) -m ruff check .
	@$(RUN) -m ruff format --check .
	@$(RUN) -m mypy

bench: .venv/bench.stamp ## measure every figure of speed beside its target (BENCH_ARGS="--short" as CI does)
	@$(RUN) -m benchmarks.run $(BENCH_ARGS)

charts: .venv/bench.stamp ## draw every chart and every picture in docs/ (CHARTS_ARGS="pareto" draws one)
	@$(RUN) -m benchmarks.charts $(CHARTS_ARGS)

paper: .venv/demo.stamp ## recompute the figures of Grigorii et al. 2021 into out/paper
	@$(RUN) -m examples.grigorii2021 --out out/paper

# A warning fails, but for those about types that pdoc looks up in the wrong module (named tuples, inherited fields).
docs: .venv/docs.stamp ## build the API reference from the docstrings into out/api
	@$(RUN) -W error::UserWarning -W "ignore:Error parsing type annotation" -m pdoc -d numpy -o out/api $(API)
	@echo "API reference: out/api/index.html"

wheel: .venv/test.stamp ## build the wheel, install it into an empty environment and render a scene there
	@.ci/wheel

clean: ## remove the environment and everything that was built or written
	@rm -rf .venv .venv-oldest build dist out *.egg-info .pytest_cache .mypy_cache .ruff_cache .hypothesis
	@find . -name __pycache__ -type d -prune -exec rm -rf {} +

.venv/made.stamp:
	@test -n "$(PYTHON)" || { echo "hapticrender needs Python >= 3.11 with the venv module; none of python3, python3.13, python3.12, python3.11 is one" >&2; exit 1; }
	@"$(PYTHON)" -m venv .venv
	@touch $@

# Not installed itself: tests import the checkout.  The oldest Python has wheels of the oldest packages.
.venv-oldest/made.stamp: pyproject.toml
	@echo "installing $(OLDEST) into .venv-oldest"
	@"$$(command -v python3.11 || echo "$(PYTHON)")" -m venv .venv-oldest
	@.venv-oldest/bin/python -m pip install --quiet --disable-pip-version-check --no-compile $(OLDEST) pytest pytest-timeout hypothesis
	@touch $@

.venv/demo.stamp: .venv/made.stamp pyproject.toml
	@echo "installing hapticrender into .venv"
	@$(INSTALL) '.[all]'
	@touch $@

.venv/test.stamp: .venv/made.stamp pyproject.toml
	@echo "installing hapticrender and its test tools into .venv"
	@$(INSTALL) '.[all,test]'
	@touch $@ .venv/demo.stamp

.venv/bench.stamp: .venv/made.stamp pyproject.toml
	@echo "installing what tests need and benchmarks compare with into .venv"
	@$(INSTALL) '.[all,test,bench]'
	@touch $@ .venv/test.stamp .venv/demo.stamp

.venv/docs.stamp: .venv/demo.stamp
	@echo "installing pdoc into .venv"
	@$(INSTALL) '.[all,docs]'
	@touch $@
