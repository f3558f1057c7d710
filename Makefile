# make test   install what is needed into .venv, check the style, run the tests
# make lint   the style alone

PYTHON ?= python3
BIN = .venv/bin

test: lint
	$(BIN)/python -m pytest

lint: .venv/installed
	$(BIN)/ruff check .

# Debian's python3 comes without venv's ensurepip; the stamp is written last, so a broken install is begun anew.
.venv/installed: requirements.txt
	$(PYTHON) -m venv .venv
	$(BIN)/python -m pip install --quiet --disable-pip-version-check -r requirements.txt
	touch $@

.PHONY: test lint
