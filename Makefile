# `make demo` shows the main job, `make quick` tests the core in a minute, `make test` all. Each creates the environment it needs.
# `make test LEARNED=1` also installs torch and kornia, and so tests the learned front ends instead of skipping them.
PYTHON ?= python3
VENV ?= .venv
LEARNED ?=
VIO_DATA ?=
WORK ?= results
RESULTS ?=
ifeq ($(OS),Windows_NT)
BIN := $(VENV)/Scripts
EXE := .exe
else
BIN := $(VENV)/bin
EXE :=
endif
TESTED := $(VENV)/$(if $(LEARNED),.learned,.dev)
# `make test CONSTRAINTS=` installs the newest versions that pyproject.toml allows.
CONSTRAINTS ?= constraints.txt
PIP_INSTALL := $(BIN)/python -m pip install --disable-pip-version-check $(addprefix -c ,$(CONSTRAINTS))

.PHONY: demo quick test lint unit oldest coverage mutations bench results wheel arm docs release clean constraints

# The demo compiles what it needs itself, while it renders; the extension module with all loops comes afterwards.
demo: $(VENV)/.base
	$(BIN)/vio demo --out demo
	@echo "the command vio: . $(BIN)/activate"
	@test -d vio/numerics/machine_code || { \
		nice $(BIN)/python -m tools.prebuild > $(VENV)/compiled.log 2>&1 & \
		echo "compiling the other loops in the background, once: about 200 s of computing (ended by: kill $$!); until then runs are slower and load 130 MiB more"; }

# Algebra, records, settings, filters, and runs on features; under a minute on two cores once the loops are compiled.
QUICK := geometry/test_lie geometry/test_stereo_geometry geometry/test_distortion numerics/test_statistics numerics/test_robust \
	project/test_jacobian_registry records/test_records cli/test_config filters/test_selectors filters/test_information \
	filters/test_navigation filters/test_multiview filters/test_window filters/test_window_tracks filters/test_motion_noise \
	filters/test_vislam filters/test_filter_inputs runs/test_pipeline
quick: $(TESTED)
	$(BIN)/python -m pytest -q -n auto --dist loadfile $(QUICK:%=tests/%.py)

test: lint unit

lint: $(TESTED)
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .
	$(BIN)/mypy

unit: $(TESTED)
	$(BIN)/python -m pytest -n auto --dist loadfile --no-loadscope-reorder

# All tests with the lowest versions that pyproject.toml allows, but without the viewer, which needs NumPy 2; on Python 3.10.
OLDEST := .venv-oldest
oldest:
	$(PYTHON) -m venv $(OLDEST)
	$(OLDEST)/bin/python -m pip install --quiet --disable-pip-version-check uv
	printf 'rerun-sdk ; sys_platform == "never"\npyparsing < 3.3\n' > $(OLDEST)/without.txt # matplotlib 3.8 uses its old names
	$(OLDEST)/bin/uv pip install --quiet --python $(OLDEST)/bin/python --compile-bytecode --resolution lowest-direct \
		--override $(OLDEST)/without.txt -e '.[dev]'
	$(OLDEST)/bin/python -m pytest -n auto --dist loadfile --no-loadscope-reorder

# All tests again, with the lines of vio/ and frontend/ that they reach; LEARNED=1 counts the learned front ends in.
coverage: $(TESTED)
	$(BIN)/python -m pytest -n auto --dist loadfile --no-loadscope-reorder --cov --cov-report=term --cov-fail-under=90

# Break the code on purpose, a line at a time: some test must fail each time (half an hour).
mutations: $(TESTED)
	$(BIN)/python -m tools.mutate

# Run the small suite of `vio bench`, rendered on the spot: exit status 1 where a run has no result (half a minute). Then what
# a frame costs beside the last commit; a change of it belongs into tools/speed.json (--write).
bench: $(VENV)/.base
	$(BIN)/vio bench small --out bench/small --cache bench/cache
	rm -rf bench/speed
	$(BIN)/vio render --out bench/speed --rig small --width 320 --rate 20 --duration 1.5 --format euroc
	$(BIN)/python -m tools.speed bench/speed

# Run the suites behind docs/results.md and the README and write their tables (VIO_DATA=recordings; an hour and a half on two
# cores); RESULTS="--only paper" runs one, RESULTS="--peers DIR" puts other systems beside. docs/results.md says what lies where.
# Without RESULTS the faults and healthy variants of docs/faults.md are run as well (half an hour more).
results: $(VENV)/.base
	$(if $(RESULTS),,$(BIN)/python -m tools.faults --data "$(VIO_DATA)" --work "$(WORK)")
	$(BIN)/python -m tools.results --data "$(VIO_DATA)" --work "$(WORK)" $(RESULTS)

# The documentation site, into site/; a broken link or a page without a place in the menu is an error.
docs: $(VENV)/.docs
	NO_MKDOCS_2_WARNING=1 $(BIN)/python -m mkdocs build --strict

# Build the wheel, and run it in an environment and a folder of its own, with the newest versions of what it needs. On Linux
# x86-64 and aarch64 this also writes, and then runs, a wheel with the machine code of its loops for this Python; where there
# is a cross compiler (Debian: g++-aarch64-linux-gnu), on x86-64 one for aarch64 as well.
wheel: | $(BIN)/python$(EXE)
	rm -rf build dist
	$(BIN)/python -m pip wheel --quiet --disable-pip-version-check --no-deps --wheel-dir dist .
	$(BIN)/python tools/check_wheel.py dist

# Run two short recordings on an emulated Arm processor, by hand: tools/arm.py says what ARM_ROOT is.
ARM_ROOT ?=
arm: $(VENV)/.base
	$(BIN)/python -m tools.arm "$(ARM_ROOT)" dist/*_aarch64.whl "$(VIO_DATA)/kitti_06_head" "$(VIO_DATA)/euroc/MH_01_head"

# All of a release but the upload: CONTRIBUTING.md tells the rest.
release: $(VENV)/.base
	$(BIN)/python -m pip install --quiet --disable-pip-version-check build twine
	$(BIN)/python -m tools.release

$(BIN)/python$(EXE):
	@echo "making the environment $(VENV): some seconds"
	$(PYTHON) -m venv $(VENV)

$(VENV)/.base: pyproject.toml $(CONSTRAINTS) | $(BIN)/python$(EXE)
	@echo "installing about 30 packages (0.9 GB) into $(VENV): a minute or more, the last of it without a line"
	$(PIP_INSTALL) -e . setuptools
	@touch $@

$(VENV)/.docs: pyproject.toml $(CONSTRAINTS) | $(BIN)/python$(EXE)
	@echo "installing the documentation's packages into $(VENV)"
	$(PIP_INSTALL) -e '.[docs]'
	@touch $@ $(VENV)/.base

$(VENV)/.dev: pyproject.toml $(CONSTRAINTS) | $(BIN)/python$(EXE)
	@echo "installing about 100 packages (2 GB) into $(VENV): minutes, the last of them without a line"
	$(PIP_INSTALL) -e '.[dev]'
	@touch $@ $(VENV)/.docs $(VENV)/.base

$(VENV)/.learned: pyproject.toml $(CONSTRAINTS) | $(BIN)/python$(EXE)
	$(PIP_INSTALL) -e '.[dev,learned]'
	@touch $@ $(VENV)/.dev $(VENV)/.base

# Take the exact versions of the present environment, all extras included, as the new constraints.
constraints: $(VENV)/.learned
	$(BIN)/python tools/freeze_constraints.py > constraints.new
	mv constraints.new constraints.txt

clean:
	rm -rf $(VENV) $(OLDEST) demo build dist site *.egg-info
