# make test   install what is needed into .venv, then make lint, then run the tests
# make lint   check the style, the types and the direction of the imports
# make lock   write requirements.txt anew, with the newest versions that pyproject.toml allows
# make demo   record, train and drive in the stand-in simulator, and show it on a page: see tools/demo.py

# make shipped RECORDINGS="FOLDER …"
#             train a network for both tracks, in sun and shade, and for unknown roads, on these recordings and on rendered
#             ones, and measure it: see tools/shipped.py

PYTHON ?= python3
RECORDINGS ?= data
BIN = .venv/bin
# Debian's python3 comes without ensurepip, which venv needs, and panda3d's wheel needs libX11 even without a screen.
# The tests look at the pages in Chromium and at the window on Xvfb's screen, and skip what they can't look at.
APT = ./.ci/apt

test:
	@$(MAKE) --no-print-directory -j 2 lint screen
	$(BIN)/python -m pytest -n 3 --dist worksteal

screen:
	@(for command in chromium Xvfb xdotool; do command -v $$command || exit; done) > /dev/null \
		|| $(APT) --optional chromium xvfb xdotool

lint: .venv/installed
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .
	$(BIN)/mypy || { [ $$? = 2 ] && $(BIN)/mypy --num-workers 0; }  # its workers may not start within 3 s
	$(BIN)/lint-imports --no-logo

# The stamp is written last, so that an interrupted installation is repeated.
.venv/installed: requirements.txt
	@$(PYTHON) -c "import sys; sys.exit('Python 3.11 or later is needed, and $(PYTHON) is Python ' + sys.version.split()[0] \
		+ ': name another, as in make demo PYTHON=python3.12' if sys.version_info < (3, 11) else 0)"
	@$(PYTHON) -c "import ensurepip" 2>/dev/null || $(APT) python3-venv
	@echo "install into .venv: some minutes; 2 GB on disk, or 5.5 GB where PyTorch brings NVIDIA's libraries: see README.md"
	$(PYTHON) -m venv .venv
	$(BIN)/python -m pip install --disable-pip-version-check --no-compile -r requirements.txt
	@# By itself, pip would compile on one core, libraries' own tests too. A few of their files are not for this Python.
	$(BIN)/python -m compileall -qq -j 0 -x '/tests?/' .venv/lib || true
	@[ "$$(uname)" != Linux ] || PATH="$$PATH:/sbin" ldconfig -p | grep -q libX11.so.6 || $(APT) libx11-6
	touch $@

# With the oldest Python, for which not all libraries' newest versions are. NVIDIA's are not for macOS and Windows.
lock:
	@$(PYTHON) -c "import sys; sys.exit('lock with the oldest Python: make lock PYTHON=python3.11' \
		if sys.version_info[:2] > (3, 11) else 0)"
	$(PYTHON) -m venv .venv-lock
	.venv-lock/bin/python -m pip install --quiet '.[simulator,gymnasium,lerobot,export,markdown,dev]'
	(head -n 2 requirements.txt; .venv-lock/bin/python -m pip list --format=freeze --exclude behavioral-cloning \
		--exclude pip --exclude setuptools \
		| sed -e 's/+.*//' -e '/^nvidia-/d' -e '/^cuda-/d' -e '/^triton=/d') > .venv-lock/requirements.txt
	mv .venv-lock/requirements.txt requirements.txt
	rm -r .venv-lock

demo: .venv/installed
	@$(BIN)/python -m tools.demo

shipped: .venv/installed
	$(BIN)/python -m tools.shipped $(RECORDINGS)

.PHONY: test screen lint lock demo shipped
