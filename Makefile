# make test   install what is needed into .venv, check the style, run the tests
# make lint   the style alone
# make demo   record, train and drive a lap in the stand-in simulator: about 15 minutes on 2 cores; stop it, run it again

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

demo: demo/lap.json
	@echo "demo/: model.pt, training_loss.png, lap.json, lap.png (the way driven), lap.mp4 (the film)"

# A step that was stopped begins anew, but training goes on where it was.
demo/recorded: .venv/installed
	@echo "1 of 3: an expert drives a lap of the lake in each direction and is recorded (1 to 2 minutes)"
	rm -rf demo/data
	$(BIN)/python -m simulator record demo/data/lake-ccw --track lake --direction ccw
	$(BIN)/python -m simulator record demo/data/lake-cw --track lake --direction cw
	touch $@

demo/trained: demo/recorded
	@echo "2 of 3: ten epochs of training (10 to 12 minutes)"
	$(BIN)/python model.py demo/data --output demo/model.pt --resume
	touch $@

demo/lap.json: demo/trained
	@echo "3 of 3: drive.py drives a lap of the lake at 9 mph (2 minutes)"
	$(BIN)/python drive.py demo/model.pt & server=$$!; trap "kill $$server" EXIT; \
	$(BIN)/python -m simulator drive --track lake --report $@ --picture demo/lap.png --film demo/lap.mp4

.PHONY: test lint demo
