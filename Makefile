# Everything a person needs, from a fresh clone, without root. PYTHON= chooses the interpreter.
VENV   := .venv
PYTHON ?=
BIN    := $(VENV)/bin
STAMP  := $(VENV)/.optsim-ready

.PHONY: force demo test test-slow test-all docs setup benchmark regress planted-faults claims own-f-number imperfections fidelity tolerances tolerances-prototype validate lint types architecture requirements clean help

force:

help: ## list the targets
	@grep -E '^[a-z0-9-]+:.*##' $(MAKEFILE_LIST) | sed 's/:.*##/\t/' | expand -t16

setup: $(STAMP) ## create .venv with the pinned dependencies and optsim itself

# Naming an interpreter means wanting it: an environment of another one is made anew.
$(STAMP): requirements.txt pyproject.toml .ci/setup.sh $(if $(PYTHON),force)
	@PYTHON="$(PYTHON)" VENV="$(VENV)" sh .ci/setup.sh
	@touch $@

demo: setup ## run the demo experiment; opens nothing, prints where the report is
	$(BIN)/optsim run demo

test: setup ## is the code right? (minutes)
	$(BIN)/python -m pytest tests -n auto --dist loadscope

test-slow: setup ## the tests that make test leaves out
	$(BIN)/python -m pytest tests -n auto --dist loadscope -m slow

test-all: test test-slow ## both tiers

docs: setup ## build the manual into site/, strictly; it opens from disk
	$(BIN)/mkdocs build --strict

benchmark: setup ## run time against peers, measured now
	$(BIN)/optsim benchmark

regress: setup ## the regression matrix against its baseline, reports/baselines/regress.json
	$(BIN)/optsim regress

planted-faults: setup ## does that gate catch faults planted into the code? writes reports/planted_faults.md
	$(BIN)/python validation/planted_faults.py

claims: setup ## figure 4 and the claims over seeds and phases of motion; writes reports/figure4.md, claims.md (hours; goes on)
	$(BIN)/python validation/claims.py

own-f-number: setup ## all schemes, each at its own f-number; writes reports/own_f_number.md (half an hour)
	$(BIN)/python validation/own_f_number.py

imperfections: setup ## what each imperfection costs in the demo; writes reports/imperfections.md (20 minutes)
	$(BIN)/python validation/imperfections.py

tolerances: setup ## tolerance sheet, waterfall and yield of the demo; writes reports/tolerances.md (90 minutes)
	$(BIN)/python validation/tolerances.py demo

tolerances-prototype: setup ## the same of the paper's prototype; writes reports/tolerances_prototype.md (a night; goes on)
	$(BIN)/python validation/tolerances.py paper_prototype

fidelity: setup ## what each fine approximation is worth; writes reports/fidelity.md (30 minutes)
	$(BIN)/python validation/fidelity.py

validate: setup ## is the model true of the world? (long; rewrites optsim/experiment/evidence.json)
	@$(BIN)/python validation/environments.py >/dev/null # first what needs a network
	$(BIN)/optsim validate --write

lint: setup
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .

types: setup
	$(BIN)/basedpyright

architecture: setup
	$(BIN)/python -m pytest -q tests/test_architecture.py

requirements: ## remake requirements.txt from pyproject.toml (needs uv)
	uv pip compile pyproject.toml --all-extras --universal --python-version 3.11 --generate-hashes \
	  --no-emit-index-url --no-annotate --custom-compile-command "make requirements" -o requirements.txt

clean:
	rm -rf $(VENV) validation/*/.venv site .pytest_cache .ruff_cache
