# make demo   fly three drones in simulation; results in out/demo/
# make test   run every test
# Both set up .venv first, once; afterwards they need no network.
# Another interpreter: make PYTHON=/path/to/python demo

SHELL := /bin/bash
.DELETE_ON_ERROR:
.PHONY: demo test .venv moved

# Neither a foreign module path nor pip's advertisement belongs in here.
unexport PYTHONPATH PYTHONHOME
export PIP_DISABLE_PIP_VERSION_CHECK := 1

demo: .venv
	@.venv/bin/python -m sitl fly demo --out out/demo --speed max

test: .venv
	@.venv/bin/python -m pytest -n auto --maxprocesses 4 --dist loadfile

.venv: .venv/.installed

# Prints the newest suitable interpreter, or "none: " and why there is none.
FIND_PYTHON = \
	candidates=(python3.13 python3.12 python3.11 python3); \
	[ -z "$(PYTHON)" ] || candidates=("$(PYTHON)"); \
	why="needs Python >= 3.11, and $${candidates[-1]} is $$("$${candidates[-1]}" --version 2>&1 | tail -n 1)"; \
	command -v "$${candidates[-1]}" >/dev/null || why="needs Python >= 3.11, and there is no $${candidates[-1]}"; \
	for python in "$${candidates[@]}"; do \
		"$$python" -c 'import sys; sys.exit(sys.version_info < (3, 11))' 2>/dev/null || continue; \
		"$$python" -c 'import venv, ensurepip' 2>/dev/null && { echo "$$python"; exit; }; \
		why="$$python has no venv; Debian and Ubuntu: apt install $${python\#\#*/}-venv"; \
	done; \
	echo "none: $$why"

# The environment that is there, if its interpreter still runs and suits.
FIND_VENV = .venv/bin/python -c 'import sys, pip; sys.exit(sys.version_info < (3, 11))' 2>/dev/null && echo kept

define MAKE_VENV
@"$(1)" -m venv --clear .venv

endef

# The stamp holds the folder's path: a folder that was moved is installed anew.
ifneq "$(shell cat .venv/.installed 2>/dev/null)" "$(CURDIR)"
.venv/.installed: moved
endif

.venv/.installed: requirements.lock pyproject.toml
	$(if $(shell $(FIND_VENV)),,$(eval python := $(shell $(FIND_PYTHON)))$(if \
	$(filter none:,$(python)),$(error $(wordlist 2,99,$(python))),$(call MAKE_VENV,$(python))))
	@echo "Installing into .venv (a minute or two, once)"
	@.venv/bin/python -m pip install --quiet --require-hashes -r requirements.lock
	@.venv/bin/python -m pip install --quiet --no-index --no-deps --no-build-isolation -e .
	@printf '%s\n' "$(CURDIR)" > $@
