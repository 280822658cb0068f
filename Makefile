# Everything is installed into .venv by scripts/setup.sh; `make help` says the rest.
SCENE ?= scenes/street_dusk_panorama.toml
PORT ?=
ARGS ?=
PYTHON ?= python3
BIN := .venv/bin

export PYTHON
# The tests start some hundred processes, each of which would compile every module again.
unexport PYTHONDONTWRITEBYTECODE

.DEFAULT_GOAL := help
.NOTPARALLEL:
.PHONY: help play test test-python lint bench docs screenshots clean

help: ## Show this
	@printf 'spherloc: see why visual localization works, and why it fails\n\n'
	@sed -n 's/^\([a-z-]*\):.*## \(.*\)/  make \1\t\2/p' $(MAKEFILE_LIST) | expand -t 20
	@printf '\nOptions, with what they are now:\n'
	@printf '  %-12s  %s\n' 'SCENE=FILE' 'scene to play ($(SCENE))' \
	  'PORT=NUMBER' 'port of the playground ($(or $(PORT),whatever `spherloc play` chooses))' \
	  'ARGS=...' "more for pytest or spherloc play: make test ARGS='-k mei -x'" \
	  'PYTHON=FILE' 'Python 3.11 or newer to start from ($(PYTHON))'

play: ## Install what it needs, start the playground and print its address
	@scripts/setup.sh play
	@trap : INT; $(BIN)/spherloc play '$(SCENE)' $(if $(PORT),--port $(PORT)) $(ARGS) || [ $$? -eq 130 ] # Ctrl-C is its end

# Processes that share two cores wait for each other's threads of OpenBLAS.
test: export OPENBLAS_NUM_THREADS = 1
# Kernels are compiled before the tests begin, for each of their processes would compile all of them.
test: ## Install what the tests need, a Chromium included, and run them all
	@SPHERLOC_CHROMIUM="$$(scripts/setup.sh test)" && export SPHERLOC_CHROMIUM && \
	  printf 'spherloc: running the tests; browser: %s\n' "$$SPHERLOC_CHROMIUM" && \
	  $(BIN)/python -c 'from spherloc.warm_up import warm_up; warm_up(lambda said: print("spherloc:", said))' && \
	  exec $(BIN)/python -m pytest -n 2 --dist loadfile --no-loadscope-reorder $(ARGS)

test-python: ## Run part of the tests with a newer Python (3.12, 3.13), if one is here
	@scripts/test_python.sh $(if $(findstring command,$(origin PYTHON)),'$(PYTHON)')

lint: ## Check style, format and types
	@scripts/setup.sh lint
	@status=0; \
	$(BIN)/python -m ruff check . || status=1; \
	$(BIN)/python -m ruff format --check . || status=1; \
	PYRIGHT_PYTHON_IGNORE_WARNINGS=1 $(BIN)/python -m pyright --threads 2 || status=1; \
	exit $$status

bench: ## Measure spherloc beside its peers, about an hour; a stopped run goes on
	@scripts/setup.sh bench
	@exec $(BIN)/python -m benchmarks.run $(ARGS)

docs: ## Build the documentation into build/docs, to be read without a network
	@scripts/setup.sh docs
	@NO_MKDOCS_2_WARNING=1 $(BIN)/python -m mkdocs -q build --strict $(ARGS)
	@printf 'spherloc: the documentation is in %s\n' build/docs/index.html

screenshots: ## Photograph every view, dark and light, into build/screenshots and docs
	@SPHERLOC_CHROMIUM="$$(scripts/setup.sh test)" && export SPHERLOC_CHROMIUM && \
	  exec $(BIN)/python scripts/screenshots.py $(ARGS)

clean: ## Remove what make installed and built here: .venv and caches
	rm -rf .venv build *.egg-info .pytest_cache .hypothesis .ruff_cache
	find . -name .git -prune -o -type d -name __pycache__ -exec rm -rf {} +
