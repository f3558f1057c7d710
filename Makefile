# make test   install what is needed into .venv, then make lint, then run the tests
# make lint   check the style, the types and the direction of the imports
# make demo   record, train and drive a lap in the stand-in simulator: about 15 minutes on 2 cores. To continue after an
#             interruption, run it again.

# make shipped RECORDINGS="FOLDER …"
#             train a network for both tracks, in sun and shade, and for unknown roads, on these recordings and on rendered
#             ones, and measure it: see tools/shipped.py

PYTHON ?= python3
RECORDINGS ?= data
BIN = .venv/bin
# Debian's python3 comes without ensurepip, which venv needs, and panda3d's wheel needs libX11 even without a screen.
APT = ./.ci/apt

test: lint
	$(BIN)/python -m pytest -n 2 --dist worksteal

lint: .venv/installed
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .
	$(BIN)/mypy
	$(BIN)/lint-imports --no-logo

# The stamp is written last, so that an interrupted installation is repeated.
.venv/installed: requirements.txt requirements-export.txt requirements-dev.txt
	@$(PYTHON) -c "import ensurepip" 2>/dev/null || $(APT) python3-venv
	@[ "$$(uname)" != Linux ] || PATH="$$PATH:/sbin" ldconfig -p | grep -q libX11.so.6 || $(APT) libx11-6
	$(PYTHON) -m venv .venv
	$(BIN)/python -m pip install --quiet --disable-pip-version-check -r requirements-dev.txt
	touch $@

demo: demo/lap.json
	@echo "demo/ holds model.pt, training_loss.png, lap.json (report), lap.png (trajectory) and lap.mp4 (film)"

# An interrupted recording starts again; an interrupted training run continues.
demo/recorded: .venv/installed
	@echo "1 of 3: record an expert that drives a lap of the lake track in each direction (1 to 2 minutes)"
	rm -rf demo/data
	$(BIN)/python -m simulator record demo/data/lake-ccw --track lake --direction ccw
	$(BIN)/python -m simulator record demo/data/lake-cw --track lake --direction cw
	touch $@

demo/trained: demo/recorded
	@echo "2 of 3: train for ten epochs (10 to 12 minutes)"
	$(BIN)/python model.py demo/data --output demo/model.pt --resume
	touch $@

demo/lap.json: demo/trained
	@echo "3 of 3: drive a lap of the lake track at 9 mph with drive.py (2 minutes)"
	$(BIN)/python drive.py demo/model.pt & server=$$!; trap "kill $$server" EXIT; \
	$(BIN)/python -m simulator drive --track lake --report $@ --picture demo/lap.png --film demo/lap.mp4

shipped: .venv/installed
	$(BIN)/python -m tools.shipped $(RECORDINGS)

.PHONY: test lint demo shipped
