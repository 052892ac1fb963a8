# A fresh machine needs make and Python 3.11, 3.12 or 3.13; everything else goes into .venv.
PYTHON ?= python3
VENV := .venv
BIN := $(VENV)/bin

.PHONY: help install demo test paper docs reference fuzz weights lint format wheel clean

help:
	@echo "make install   a virtual environment in $(VENV) with semloc and the tools of development"
	@echo "make demo      two simulated drives, their loop closures, and an annotated log, in demo/"
	@echo "make test      all tests"
	@echo "make paper     every system of the paper on a small scene, in paper-quick/"
	@echo "make docs      the documentation, in docs/build/"
	@echo "make reference the generated pages of the documentation only"
	@echo "make fuzz      damaged messages and logs for MINUTES (1) from SEED (0) on"
	@echo "make weights   the descriptor of 16 million subvolumes, in weights/, in runs of MINUTES (9);"
	@echo "               goes on where it stopped"
	@echo "make lint      ruff and mypy"
	@echo "make format    ruff format"
	@echo "make wheel     the wheel, in dist/"
	@echo "make clean     remove what these made"

$(VENV)/installed: pyproject.toml constraints.txt
	@$(PYTHON) -c 'import sys; sys.exit(not (3, 11) <= sys.version_info[:2] <= (3, 13))' || \
		{ echo "Python 3.11, 3.12 or 3.13 is needed: make $(MAKECMDGOALS) PYTHON=/path/to/python3.12" >&2; exit 1; }
	$(PYTHON) -m venv $(VENV)
	$(BIN)/python -m pip install --quiet -c constraints.txt -e '.[dev,sim]'
	@touch $@

install: $(VENV)/installed

demo: install
	$(BIN)/semloc demo -o demo

test: install
	$(BIN)/python -m pytest -n 2 --dist loadfile

paper: install
	$(BIN)/semloc benchmark paper --quick -o paper-quick

$(VENV)/installed-docs: $(VENV)/installed
	$(BIN)/python -m pip install --quiet -c constraints.txt -e '.[docs]'
	@touch $@

reference: install
	$(BIN)/python -P docs/generate.py

docs: reference $(VENV)/installed-docs
	$(BIN)/python -m sphinx -W --keep-going -q -b html docs docs/build

fuzz: install
	$(BIN)/python -P benchmarks/fuzz.py --minutes $(or $(MINUTES),1) --seed $(or $(SEED),0)

# exit code 3: the minutes are over. A batch system starts the same command again; here a loop does,
# one variant in turn with the other
weights: install
	@left="semantic geometric"; while [ -n "$$left" ]; do \
		again=""; \
		for variant in $$left; do \
			$(BIN)/semloc train -o weights --variant $$variant --samples $(or $(SAMPLES),16000000) \
				--scenes 4000 --set training.batch=48 --jobs $(or $(JOBS),1) \
				--minutes $(or $(MINUTES),9); \
			code=$$?; \
			case $$code in 0) ;; 3) again="$$again $$variant" ;; *) exit $$code ;; esac; \
		done; \
		left="$$again"; \
	done

lint: install
	$(BIN)/ruff check
	$(BIN)/ruff format --check
	$(BIN)/mypy
	$(BIN)/python .ci/speech.py

format: install
	$(BIN)/ruff format
	$(BIN)/ruff check --fix

wheel: install
	$(BIN)/python -m build --wheel

clean:
	rm -rf $(VENV) build dist demo paper-quick docs/build *.egg-info
	rm -rf .mypy_cache .ruff_cache .pytest_cache .hypothesis
