# make test   install what is needed into .venv, check the style, run the tests
# make lint   the style alone

PYTHON ?= python3
BIN = .venv/bin
# Debian's python3 lacks the means to make a virtual environment, and panda3d's wheel libX11 (no screen is needed).
APT = ./.ci/apt

test: lint
	$(BIN)/python -m pytest

lint: .venv/installed
	$(BIN)/ruff check .

# The stamp is written last, so that a broken install is begun anew.
.venv/installed: requirements.txt
	@$(PYTHON) -c "import ensurepip" 2>/dev/null || $(APT) python3-venv
	@ldconfig -p | grep -q libX11.so.6 || $(APT) libx11-6
	$(PYTHON) -m venv .venv
	$(BIN)/python -m pip install --quiet --disable-pip-version-check -r requirements.txt
	touch $@

.PHONY: test lint
