# `make demo` and `make test` each install what they need first; both work on a fresh machine.
PYTHON ?= python3
BIN := .venv/bin
OUT := runs/demo-$(shell date +%Y%m%d-%H%M%S)

.PHONY: install demo check test test-slow test-release test-all test-versions site
install: .venv/installed

.venv/installed: pyproject.toml
	$(PYTHON) -c "import sys; sys.exit(sys.version_info < (3, 11) and 'Python 3.11 or newer is needed: make PYTHON=python3.12 ...')"
	$(PYTHON) -m venv .venv
	$(BIN)/python -m pip install --quiet --disable-pip-version-check -e '.[dev]'
	touch $@

demo: install
	$(BIN)/python -m experiments.focus --out $(OUT)/focus
	$(BIN)/python -m experiments.edof --config configs/demo/edof.yaml --out $(OUT)/edof
	@echo "Demo finished: open $(OUT)/focus/report.html and $(OUT)/edof/report.html"
	$(BIN)/python -m drt_jax check

# Style and types.
check: install
	$(BIN)/ruff check
	$(BIN)/ruff format --check
	$(BIN)/mypy

# Programs that one run of the tests has compiled serve the next.
test test-slow test-release test-all test-versions site: export JAX_COMPILATION_CACHE_DIR ?= $(CURDIR)/.compiled

# With PART=0 to 6, as in CI, also a seventh of the larger scenes.
test: install
	$(BIN)/python -m pytest $(if $(PART),-m "not release" --durations=60 --part=$(PART))

# The larger scenes; PART as above.
test-slow: install
	$(BIN)/python -m pytest -m slow --durations=60 $(if $(PART),--part=$(PART))

# Evidence that takes minutes a test.
test-release: install
	$(BIN)/python -m pytest -m release --durations=0

test-all: install
	$(BIN)/python -m pytest -m "" --durations=60

# A part of the tests with other releases of Python and JAX, where there are such Pythons.
test-versions: install
	$(BIN)/python .ci/versions.py

# The pages of docs/ with their notebooks, which are run: docs/_build/html/index.html.
site: install
	$(BIN)/python -m pip install --quiet --disable-pip-version-check -e '.[docs]'
	$(BIN)/sphinx-build -q -W --keep-going -j 2 docs docs/_build/html
