# Every check and its set-up in one command each. Virtual environments are made on first use.

PYTHON ?= python3
BIN := .venv/bin
TORCH := $(shell grep '^torch==' constraints.txt)
# Hundreds of processes start in the tests: without bytecode on disk each compiles all modules anew.
unexport PYTHONDONTWRITEBYTECODE
OLDEST_GYMNASIUM := $(shell sed -n 's/.*"gymnasium>=\([0-9.]*\),.*/gymnasium==\1/p' pyproject.toml)
CLIENTS ?= clients rllib torchrl minari
# Makes the environment of a target anew, and keeps git from seeing it.
MAKE_VENV = @echo "Setting up $(@D)" && $(PYTHON) -m venv --clear $(@D) && echo '*' > $(@D)/.gitignore

.PHONY: help demo test test-slow test-release coverage golden generated lint format types supply-chain docs lock locked gymnasium-oldest dist examples deepmimo clean

help: ## list these targets
	@awk -F ':.*## ' '/^[a-z-]+:.*## / { printf "make %-18s %s\n", $$1, $$2 }' Makefile

demo: .venv/.base ## compare the contenders; prints a table and writes all of it to results/
	$(BIN)/mmwave-loc demo

# Tests of a file share what they compile: each process gets a run of files, and whoever is done helps.
test: .venv/.dev ## all tests but the slow ones; FLAGS="..." are for pytest
	$(BIN)/python -m pytest -m "not slow" -n auto --dist worksteal $(FLAGS)

test-slow: .venv/.dev ## the slow tests
	$(BIN)/python -m pytest -m "slow and not release" -n auto --dist worksteal --durations=15

test-release: .venv/.dev ## before a release: complete trainings, the figures of the paper's page
	$(BIN)/python -m pytest -m release -n auto --dist worksteal --durations=0

golden: .venv/.dev ## write tests/golden anew, after a change that is to move numbers; FLAGS=--check compares exactly
	$(BIN)/python -m tests.golden.write $(FLAGS)

generated: .venv/.dev ## write anew what is made from code: JSON schemas, pages and a picture of docs
	$(BIN)/python -m tests.schemas
	PYTHONPATH=. $(BIN)/python docs/site/generated_pages.py
	PYTHONPATH=. $(BIN)/python docs/site/angles.py

coverage: ## the same tests, and the lines and branches they miss; 90 % must be covered
	@$(MAKE) test FLAGS="--cov --cov-report="
	$(BIN)/coverage report --fail-under=90

lint: .venv-tools/.ready ## ruff: rules and formatting
	.venv-tools/bin/ruff check .
	.venv-tools/bin/ruff format --check .

format: .venv-tools/.ready ## ruff: sort imports and format
	.venv-tools/bin/ruff check --select I --fix .
	.venv-tools/bin/ruff format .

types: .venv/.dev ## mypy, strict
	$(BIN)/mypy mmwave_env policies experiments docs/site

supply-chain: .venv/.dev ## unused and undeclared dependencies, and the workflows
	$(BIN)/deptry .
	$(BIN)/zizmor --offline .github/workflows

docs: .venv-tools/.ready ## the documentation site, into site/; its warnings are errors
	.venv-tools/bin/python -m properdocs build --strict -f mkdocs.yml

LOCKED := plot filterpy render data tune
lock: .venv-locked/.uv ## requirements.lock anew: every package that the tests without PyTorch need, by its hashes
	printf '%s\n' setuptools pytest pytest-xdist hypothesis jsonschema gpxpy pandas pynmea2 | .venv-locked/bin/uv pip compile \
		--quiet --universal --python-version 3.11 --generate-hashes --no-annotate -c constraints.txt \
		--custom-compile-command "make lock" $(LOCKED:%=--extra %) pyproject.toml - -o requirements.lock

locked: .venv-locked/.ready ## the tests without PyTorch on exactly the packages of requirements.lock
	.venv-locked/bin/python -m pytest -m "not slow and not torch" -n auto --dist worksteal

gymnasium-oldest: .venv-oldest/.ready ## the environment on the oldest Gymnasium supported
	.venv-oldest/bin/python -m pytest -m "not slow and not torch" -n auto tests/environment/test_env.py tests/environment/test_vector_env.py

dist: .venv/.dev ## what would be published, checked: sdist and wheel, their metadata, a fresh install
	rm -rf dist
	$(BIN)/python -m build
	$(BIN)/python -m twine check --strict dist/*
	$(PYTHON) -m venv --clear .venv-dist
	@echo '*' > .venv-dist/.gitignore
	env -u PYTHONPATH .venv-dist/bin/python -m pip install --quiet dist/*.whl
	cd .venv-dist && env -u PYTHONPATH bin/mmwave-loc --help
	cd .venv-dist && env -u PYTHONPATH bin/mmwave-loc compare --policies imm --episodes 10

examples: ## every example with its library, at the version in pyproject.toml; CLIENTS="..." chooses
	@for name in $(CLIENTS); do $(MAKE) --no-print-directory -B .venv-examples/.ready NAME=$$name && \
		.venv-examples/bin/python -m pytest -m slow tests/test_examples.py --durations=0 || exit 1; done

deepmimo: ## the shipped DeepMIMO folders in DeepMIMO's own package
	@$(MAKE) --no-print-directory -B .venv-examples/.ready NAME=deepmimo
	.venv-examples/bin/python -m pytest $$(git ls-files 'tests/*deepmimo/test_package.py')

clean: ## remove environments, caches and build outputs; results/ and runs/ stay
	rm -rf .venv .venv-* build dist site *.egg-info .coverage .coverage.* coverage.xml
	rm -rf .pytest_cache .mypy_cache .ruff_cache .hypothesis
	find . -name __pycache__ -type d -prune -exec rm -rf {} +

.venv/.base: pyproject.toml constraints.txt
	@echo "Setting up .venv: the base install, about 600 MB"
	@$(PYTHON) -m venv .venv
	@$(BIN)/python -m pip install --quiet -c constraints.txt --editable '.[plot,filterpy]'
	@touch $@

.venv/.dev: .venv/.base
	@echo "Setting up .venv: PyTorch and what the tests need, about 1.5 GB more"
	@$(BIN)/python -m pip install $(TORCH)
	@$(BIN)/python -m pip install --quiet -c constraints.txt --editable '.[dev]'
	@touch $@

.venv-tools/.ready: pyproject.toml constraints.txt
	$(MAKE_VENV)
	@$(@D)/bin/python -m pip install --quiet -c constraints.txt --editable '.[lint,docs]'
	@touch $@

.venv-oldest/.ready: pyproject.toml constraints.txt
	$(MAKE_VENV)
	@$(@D)/bin/python -m pip install --quiet -c constraints.txt \
		--editable '.[render,filterpy]' $(OLDEST_GYMNASIUM) pytest pytest-xdist hypothesis
	@touch $@

.venv-locked/.uv:
	$(MAKE_VENV)
	@$(@D)/bin/python -m pip install --quiet uv
	@touch $@

.venv-locked/.ready: requirements.lock pyproject.toml
	$(MAKE_VENV)
	@$(@D)/bin/python -m pip install --quiet --require-hashes -r requirements.lock
	@$(@D)/bin/python -m pip install --quiet --no-deps --no-build-isolation --editable .
	@touch $@

.venv-examples/.ready: pyproject.toml # NAME: one of its dependency groups
	$(MAKE_VENV)
	@$(@D)/bin/python -m pip install --quiet --upgrade pip
	@test $(NAME) = deepmimo || $(@D)/bin/python -m pip install $(TORCH)
	@$(@D)/bin/python -m pip install --quiet --group $(NAME) --editable . pytest
	@touch $@
