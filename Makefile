# The two commands a newcomer needs: make demo, make test. Both need Python 3.11 with venv, and make.
PYTHON ?= python3
VENV := .venv
BIN := $(VENV)/bin
STAMP := $(VENV)/.installed
KERNELS := $(wildcard btfkit/native/*.hpp btfkit/native/*/*.cpp btfkit/native/*/*.hpp)

.PHONY: demo test test-quick check bench campaign sample wheel docs clean

demo: $(STAMP)
	$(BIN)/python examples/demo.py

test: check
	$(BIN)/python -m pytest -n 2 --dist worksteal

test-quick: $(STAMP)
	$(BIN)/python -m pytest -n 2 --dist worksteal -m "not slow and not gpu and not browser"

check: $(STAMP)
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .
	$(BIN)/mypy
	$(BIN)/lint-imports

# Hours of hostile input, kills, full disks and random queries; what they tried adds up in docs/campaigns.md.
# make campaign MINUTES=600 NAMES="readers kills"
campaign: $(STAMP)
	PYTHONPATH=tests:tests/devices:tests/export OMP_NUM_THREADS=1 BTFKIT_THREADS=1 \
	  $(BIN)/python -W ignore -m campaigns $(NAMES) --minutes $(or $(MINUTES),60)

# Five minutes of all campaigns together, the same seeds every time; a find is an error.
sample: $(STAMP)
	PYTHONPATH=tests:tests/devices:tests/export OMP_NUM_THREADS=1 BTFKIT_THREADS=1 \
	  $(BIN)/python -W ignore -m campaigns --sample --minutes $(or $(MINUTES),15)

# Wheels for glibc 2.28 and later, and an sdist, checked: make wheel PYTHONS="python3.11 python3.12"
wheel:
	$(PYTHON) packaging/wheel.py $(PYTHONS)

# The documentation as a site, in build/site; a warning is an error.
docs: $(STAMP)
	$(BIN)/python packaging/extra.py docs | xargs -d '\n' \
	  $(BIN)/python -m pip install --quiet --disable-pip-version-check --retries 3 --timeout 60
	$(BIN)/python -m mkdocs build

bench: $(STAMP)
	$(BIN)/btfkit bench

$(STAMP): pyproject.toml constraints.txt CMakeLists.txt btfkit/conventions.py $(KERNELS)
	@$(PYTHON) -c 'import sys; sys.exit(sys.version_info < (3, 11))' || \
	  { echo "btfkit needs Python 3.11 or later; name one: make PYTHON=python3.11 $(MAKECMDGOALS)"; exit 1; }
	@$(PYTHON) -c 'import venv, ensurepip' 2>/dev/null || \
	  { echo "Python's venv is missing: apt-get install python3-venv"; exit 1; }
	@command -v c++ >/dev/null || command -v g++ >/dev/null || command -v clang++ >/dev/null || \
	  echo "no C++ compiler: btfkit runs on its plain twins, correct but slower; apt-get install g++ for the kernels"
	test -x $(BIN)/python || $(PYTHON) -m venv $(VENV)
	@echo "installing btfkit and what it needs into $(VENV): a few minutes, about 1.5 GB"
	$(BIN)/python -m pip install --progress-bar on --disable-pip-version-check -c constraints.txt -e ".[dev]"
	touch $@

clean:
	rm -rf build dist demo .pytest_cache .mypy_cache .ruff_cache .hypothesis
