# Every check and its set-up in one command each. Virtual environments are made on first use.

PYTHON ?= python3
BIN := .venv/bin
TORCH := $(shell grep '^torch==' constraints.txt)
FRESH := env -u PYTHONPATH .venv-dist/fresh/bin# sees the wheel, not this folder
# Hundreds of processes start in the tests: without bytecode on disk each compiles all modules anew.
unexport PYTHONDONTWRITEBYTECODE
OLDEST_GYMNASIUM := $(shell sed -n 's/.*"gymnasium>=\([0-9.]*\),.*/gymnasium==\1/p' pyproject.toml)

.PHONY: help demo test test-slow coverage golden schemas lint format types types-base supply-chain lock locked gymnasium-oldest deepmimo ray docs dist examples clean

help: ## list these targets
	@awk -F ':.*## ' '/^[a-z-]+:.*## / { printf "make %-18s %s\n", $$1, $$2 }' Makefile

demo: .venv/.base ## compare every policy; prints six of them and writes all to results/
	$(BIN)/mmwave-loc demo

# Tests of a file share what they compile: each process gets a run of files, and whoever is done helps.
test: .venv/.dev ## all tests but the slow ones; FLAGS="..." are for pytest
	$(BIN)/python -m pytest -m "not slow" -n auto --dist worksteal $(FLAGS)

test-slow: .venv/.dev ## the slow tests
	$(BIN)/python -m pytest -m slow -n auto --durations=15

golden: .venv/.dev ## write tests/golden anew, after a change that is to move numbers
	$(BIN)/python -m tests.golden.write

schemas: .venv/.dev ## write the JSON schemas anew, after a change of what a file may hold
	$(BIN)/python -m tests.schemas

coverage: ## the same tests, and the lines and branches they miss; 90 % must be covered
	@$(MAKE) test FLAGS="--cov --cov-report="
	$(BIN)/coverage report --fail-under=90

lint: .venv-lint/.ready ## ruff: rules and formatting
	.venv-lint/bin/ruff check .
	.venv-lint/bin/ruff format --check .

format: .venv-lint/.ready ## ruff: sort imports and format
	.venv-lint/bin/ruff check --select I --fix .
	.venv-lint/bin/ruff format .

types-base: .venv-lint/.ready ## mypy without PyTorch, whose types are then unknown: quick to set up
	.venv-lint/bin/mypy --allow-subclassing-any --allow-untyped-decorators --no-warn-return-any \
		--no-warn-redundant-casts mmwave_env policies experiments

types: .venv/.dev ## mypy, strict
	$(BIN)/mypy mmwave_env policies experiments

supply-chain: .venv/.dev ## unused and undeclared dependencies, and the workflows
	$(BIN)/deptry .
	$(BIN)/zizmor --offline .github/workflows

LOCKED := plot filterpy video data sweep tune offline completion
lock: .venv-locked/.uv ## requirements.lock anew: every package that the tests without PyTorch need, by its hashes
	printf '%s\n' setuptools pytest pytest-xdist hypothesis jsonschema | .venv-locked/bin/uv pip compile \
		--quiet --universal --python-version 3.10 --generate-hashes --no-annotate -c constraints.txt \
		--custom-compile-command "make lock" $(LOCKED:%=--extra %) pyproject.toml - -o requirements.lock

locked: .venv-locked/.ready ## the tests without PyTorch on exactly the packages of requirements.lock
	.venv-locked/bin/python -m pytest -m "not slow and not torch" -n auto --dist worksteal

gymnasium-oldest: .venv-oldest/.ready ## the environment on the oldest Gymnasium supported
	.venv-oldest/bin/python -m pytest -m "not slow and not torch" -n auto tests/test_env.py tests/test_vector_env.py

deepmimo: .venv-deepmimo/.ready ## our DeepMIMO folders, shipped and written, in DeepMIMO's own packages
	.venv-deepmimo/bin/python -m pytest tests/episodes/deepmimo/test_package.py

ray: .venv-ray/.ready ## sweeps and searches by Ray
	.venv-ray/bin/python -m pytest tests/sweeping tests/commands/test_sweep.py -m slow -k "ray or trials"

docs: .venv-docs/.ready ## the documentation site, into site/; its warnings are errors
	NO_MKDOCS_2_WARNING=1 .venv-docs/bin/python -m mkdocs build --strict

dist: .venv-dist/.ready ## what would be published, checked: sdist and wheel, their metadata, a fresh install
	rm -rf dist
	.venv-dist/bin/python -m build
	.venv-dist/bin/python -m twine check --strict dist/*
	$(PYTHON) -m venv --clear .venv-dist/fresh
	$(FRESH)/python -m pip install --quiet dist/*.whl
	$(FRESH)/mmwave-loc --help
	$(FRESH)/mmwave-loc evaluate --policy imm --episodes 10

# Each environment has the libraries of one examples/NAME.txt; RLlib and TorchRL have one of their own.
examples: .venv-clients/.ready .venv-rllib/.ready .venv-torchrl/.ready ## every example with its library, at the version of docs/clients.md
	.venv-clients/bin/python -m pytest -m slow tests/test_examples.py --durations=0
	.venv-rllib/bin/python -m pytest -m slow tests/test_examples.py -k rllib
	.venv-torchrl/bin/python -m pytest -m slow tests/test_examples.py -k torchrl

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
	@echo "Setting up .venv: PyTorch and what the tests need, about 1.3 GB more"
	@$(BIN)/python -m pip install $(TORCH)
	@$(BIN)/python -m pip install --quiet -c constraints.txt --editable '.[dev]'
	@touch $@

.venv-lint/.ready: pyproject.toml constraints.txt
	@echo "Setting up .venv-lint: ruff, mypy and the base install"
	@$(PYTHON) -m venv .venv-lint
	@echo '*' > .venv-lint/.gitignore
	@.venv-lint/bin/python -m pip install --quiet -c constraints.txt --editable '.[lint]'
	@touch $@

.venv-oldest/.ready: pyproject.toml constraints.txt
	@echo "Setting up .venv-oldest: $(OLDEST_GYMNASIUM)"
	@$(PYTHON) -m venv .venv-oldest
	@echo '*' > .venv-oldest/.gitignore
	@.venv-oldest/bin/python -m pip install --quiet -c constraints.txt \
		--editable '.[render,filterpy]' $(OLDEST_GYMNASIUM) pytest pytest-xdist hypothesis
	@touch $@

.venv-locked/.uv:
	@$(PYTHON) -m venv .venv-locked
	@echo '*' > .venv-locked/.gitignore
	@.venv-locked/bin/python -m pip install --quiet uv
	@touch $@

.venv-locked/.ready: requirements.lock pyproject.toml
	@echo "Setting up .venv-locked: requirements.lock"
	@$(PYTHON) -m venv --clear .venv-locked
	@echo '*' > .venv-locked/.gitignore
	@.venv-locked/bin/python -m pip install --quiet --require-hashes -r requirements.lock
	@.venv-locked/bin/python -m pip install --quiet --no-deps --no-build-isolation --editable .
	@touch $@

# Without the constraints: deepmimo wants an older numpy.
.venv-deepmimo/.ready: pyproject.toml
	@echo "Setting up .venv-deepmimo: deepmimo and the base install"
	@$(PYTHON) -m venv .venv-deepmimo
	@echo '*' > .venv-deepmimo/.gitignore
	@.venv-deepmimo/bin/python -m pip install --quiet --editable '.[filterpy]' 'deepmimo>=4.0.5,<5' 'DeepMIMOv3==0.2.9' pytest hypothesis
	@touch $@

.venv-ray/.ready: pyproject.toml constraints.txt
	@echo "Setting up .venv-ray: Ray, PyTorch and the base install"
	@$(PYTHON) -m venv .venv-ray
	@echo '*' > .venv-ray/.gitignore
	@.venv-ray/bin/python -m pip install $(TORCH)
	@.venv-ray/bin/python -m pip install --quiet -c constraints.txt --editable '.[ray,train]' pytest hypothesis
	@touch $@

.venv-docs/.ready: pyproject.toml constraints.txt
	@echo "Setting up .venv-docs: mkdocs and the base install"
	@$(PYTHON) -m venv .venv-docs
	@echo '*' > .venv-docs/.gitignore
	@.venv-docs/bin/python -m pip install --quiet -c constraints.txt --editable '.[docs]'
	@touch $@

.venv-dist/.ready:
	@echo "Setting up .venv-dist: build and twine"
	@$(PYTHON) -m venv .venv-dist
	@echo '*' > .venv-dist/.gitignore
	@.venv-dist/bin/python -m pip install --quiet build twine
	@touch $@

.venv-clients/.ready .venv-rllib/.ready .venv-torchrl/.ready: .venv-%/.ready: examples/%.txt pyproject.toml constraints.txt
	@echo "Setting up .venv-$*: PyTorch and what examples/$*.txt lists, about 1.5 GB"
	@$(PYTHON) -m venv .venv-$*
	@echo '*' > .venv-$*/.gitignore
	@.venv-$*/bin/python -m pip install $(TORCH)
	@.venv-$*/bin/python -m pip install --quiet -c constraints.txt -r $< --editable . pytest
	@touch $@
