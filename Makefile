# Every target sets up what it needs; `make demo` and `make test` are the two to know.
PYTHON ?= python3.11
BIN := .venv/bin

.PHONY: install demo test test-reliability benchmark lint clean

install: .venv/installed

.venv/installed: pyproject.toml constraints.txt
	test -x $(BIN)/python || $(PYTHON) -m venv .venv
	$(BIN)/python -m pip install --quiet --disable-pip-version-check torch==2.13.0 -c constraints.txt
	$(BIN)/python -m pip install --quiet --disable-pip-version-check -e '.[dev]' -c constraints.txt
	touch $@

demo: install
	$(BIN)/solar run --task nav --method solar --seeds 1
	$(BIN)/solar report

test: install
	$(BIN)/python -m pytest -n 2

test-reliability: install
	$(BIN)/python -m pytest tests/reliability

benchmark: install
	$(BIN)/python -m pytest tests/benchmarks -s

lint: install
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .
	$(BIN)/mypy

clean:
	rm -rf .venv dist .pytest_cache .mypy_cache .ruff_cache
