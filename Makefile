# What a stranger types. `make demo` and `make test` do all the set-up on a machine with Python 3.11+.

PYTHON ?= python3
VENV ?= .venv
BIN := $(VENV)/bin

# What makes environments and installs packages into them: pip, or uv (make UV=uv), which is several times as fast.
UV ?=
venv = $(if $(UV),$(UV) venv -q --allow-existing --python $(PYTHON) $(1),$(PYTHON) -m venv $(1))
install = $(if $(UV),$(UV) pip install -q --python $(1)/bin/python,$(1)/bin/python -m pip --disable-pip-version-check -q install)
PIP = $(call install,$(VENV)) -c constraints.txt

# The published survey and network, which `magtwin fetch aprilab` downloads; `make paper` uses them if they exist.
SURVEYS ?= aprilab/map
RELEASED ?= aprilab/models/nn_magnetometer_model_v0.0.1.pth

# Where `make simready` installs NVIDIA's validator of profiles; with it in MAGTWIN_SIMREADY, `make test` uses it too.
SIMREADY := $(CURDIR)/build/simready/bin/simready-validate

# Largest size of the default install without bytecode, PyTorch for CPU included [MiB].
MOST_MB := 2350

# Two processes whose linear algebra has threads of its own wait for each other more than they work.
ONE_THREAD := OPENBLAS_NUM_THREADS=1 OMP_NUM_THREADS=1

.PHONY: startup fuzz faults demo test test-slow readme simready blender ros released physics physx lint typed paper bench bench-peers zoo locks locks-test wheel-test schema assets pictures clean help

help:  ## Say what there is to make
	@grep -hE '^[a-z-]+:.*## ' $(MAKEFILE_LIST) | sed -E 's/:.*## /\t/' | expand -t 14

demo: $(VENV)/.installed  ## Author a lab and a robot, drive it, log the run to demo/
	$(BIN)/magtwin demo --out demo --force

test: $(VENV)/.dev  ## Run the tests
	$(ONE_THREAD) $(BIN)/python -m pytest -n 2 --dist loadfile --no-loadscope-reorder -m "not slow"

test-slow: $(VENV)/.dev  ## Run the tests that take minutes: fits of large surveys
	$(BIN)/python -m pytest -m slow

readme: $(VENV)/.dev  ## Type README's commands in an empty folder and check the figures that it states
	$(ONE_THREAD) $(BIN)/python tests/readme.py

simready: $(VENV)/.dev build/simready/.installed  ## Hold robots against NVIDIA's SimReady profiles, in an environment of its own
	MAGTWIN_SIMREADY=$(SIMREADY) $(BIN)/python -m pytest tests/urdf/test_urdf_layout.py tests/export/test_validate.py -k "simready or layout"

ros: $(VENV)/.dev build/ros-jazzy/.installed build/ros-kilted/.installed  ## Cross our nodes with rclpy of ROS 2 Jazzy and Kilted, in environments of their own
	$(ONE_THREAD) $(BIN)/python -m pytest tests/ros/test_ros_bus.py tests/ros/test_ros_rclpy.py

released: $(VENV)/.dev build/ros-jazzy/.installed  ## Drive APRILab's released ROS 2 nodes for a minute beside the simulated robot
	$(ONE_THREAD) $(BIN)/python -m pytest tests/ros/test_ros_released.py

blender: $(VENV)/.dev build/blender/.installed  ## Import exports in Blender (bpy, 1 GB, Python 3.11), in an environment of its own
	$(ONE_THREAD) MAGTWIN_BLENDER=$(CURDIR)/build/blender/bin/python $(BIN)/python -m pytest tests/export/test_blender.py

bench-peers: $(VENV)/.dev build/peers/.installed  ## Benchmark filters of filterpy and Stone Soup, 12 runs a scenario (BENCH="--only tracking")
	$(ONE_THREAD) PYTHONPATH=benchmarks:build/peers $(BIN)/magtwin bench standard --runs 12 --localizer peers:FilterpyEkf peers:StoneSoupParticles --out build/results-peers $(BENCH)

build/peers/.installed:
	$(call install,$(VENV)) --target build/peers --no-deps 'filterpy==2.0.0' 'stonesoup==1.9.1' 'ordered-set==4.1.0'
	@touch $@

build/blender/.installed:
	$(call venv,build/blender)
	$(call install,build/blender) 'bpy==5.0.1'
	@touch $@

build/simready/.installed:
	$(call venv,build/simready)
	$(call install,build/simready) 'simready-validate>=2026.8' 'simready-foundation-tier-core>=2026.8' 'simready-foundation-tier-sensors>=2026.8'
	@touch $@

build/pyright/.installed:
	$(call venv,build/pyright)
	$(call install,build/pyright) 'pyright>=1.1.400'
	$(call install,build/pyright) --target build/pyright/stubs types-usd
	@touch $@

build/ros-%/.installed:
	$(call venv,build/ros-$*)
	$(call install,build/ros-$*) numpy 'ros-$*-rclpy[fastrtps]' ros-$*-sensor-msgs ros-$*-geometry-msgs ros-$*-nav-msgs ros-$*-rosgraph-msgs ros-$*-diagnostic-msgs ros-$*-std-srvs
	$(call install,build/ros-$*) --target build/ros-$*/numpy1 'numpy<2'
	@touch $@

lint: $(VENV)/.dev  ## Format, lint, types, import rules, dependencies, size, locks, walks
	$(BIN)/ruff format --check .
	$(BIN)/ruff check --no-cache .
	$(BIN)/mypy
	$(BIN)/lint-imports
	$(BIN)/deptry .
	$(BIN)/python .ci/house.py
	$(BIN)/python .ci/locks.py --check
	$(BIN)/python .ci/walks.py

typed: $(VENV)/.dev build/pyright/.installed  ## Check the types of docs/python.md as editors do, with pyright
	$(BIN)/python docs/python.py build/pyright/page.py
	build/pyright/bin/pyright --project .

physics: $(VENV)/.physics  ## Drive converted robots in Newton (extra physics, 600 MB)
	$(BIN)/python -m pytest -m physics tests/sim/engines/test_newton.py tests/sim/engines/test_engine.py tests/export/test_engine_scripts.py tests/export/test_validate.py

physx: $(VENV)/.dev  ## Drive the labs in NVIDIA's PhysX on the CPU (1 GB, in an environment of its own)
	test -x build/physx/bin/python || $(call venv,build/physx)
	$(call install,build/physx) 'ovphysx>=0.7' 'physx-usd-schemas>=25.11' 'newton-usd-schemas>=0.6'
	MAGTWIN_PHYSX=$(CURDIR)/build/physx/bin/python $(ONE_THREAD) $(BIN)/python -m pytest -n 2 benchmarks/physx

paper: $(VENV)/.dev  ## Measure the tables of docs/results.md and README again (up to an hour)
	$(BIN)/python docs/results.py $(if $(wildcard $(SURVEYS)),--surveys $(SURVEYS)) $(if $(wildcard $(RELEASED)),--released $(RELEASED))

fuzz: $(VENV)/.dev  ## Damage files of every format at random and read them (SECONDS=300 SEED=0 JOBS=1)
	$(ONE_THREAD) $(BIN)/python tests/fuzz/fuzz.py --seconds $(or $(SECONDS),300) --seed $(or $(SEED),0) --jobs $(or $(JOBS),1)

faults: $(VENV)/.dev  ## Fill the disk, or kill the process, at each write of every command (Linux, a C compiler; SEED=0)
	$(ONE_THREAD) $(BIN)/python tests/faults/faults.py --seed $(or $(SEED),0)

startup: $(VENV)/.dev  ## Measure what small commands cost, as ratios; fails if one fell by 15 %
	$(BIN)/python benchmarks/startup.py

bench: $(VENV)/.dev  ## Compare with peers; prints ratios
	for script in benchmarks/*.py; do $(BIN)/python $$script || exit 1; done

zoo: $(VENV)/.physics  ## Convert, validate and try 83 public robots (FROM=DIR: checkouts OWNER+NAME; ZOO="--only NAME --jobs 2")
	$(ONE_THREAD) $(BIN)/python benchmarks/zoo/zoo.py $(if $(FROM),--from $(FROM)) $(ZOO)

locks: $(VENV)/.dev  ## Write the locks with hashes anew, for constraints.txt (locks/; needs uv)
	$(BIN)/python .ci/locks.py

locks-test:  ## Install the default lock with its hashes into an empty environment, and the wheel without dependencies
	rm -rf build/locks && mkdir -p build/locks
	$(call venv,build/locks/venv)
	$(call install,build/locks/venv) --require-hashes -r locks/default.txt -r locks/view.txt
	$(call install,build/locks/venv) --no-deps .
	build/locks/venv/bin/magtwin doctor

wheel-test: $(VENV)/.dev  ## Build the wheel, install it in an empty environment, run the demo from there; write its licences
	rm -rf build/wheel && mkdir -p build/wheel
	$(if $(UV),$(UV) build -q --wheel --out-dir build/wheel .,$(BIN)/python -m build -q --wheel --outdir build/wheel .)
	$(call venv,build/wheel/venv)
	$(call install,build/wheel/venv) $(if $(UV),,--no-compile) -c constraints.txt build/wheel/*.whl
	@size=$$(du -sm build/wheel/venv | cut -f1); echo "The default install takes $$size MB"; test $$size -le $(MOST_MB)
	build/wheel/venv/bin/python .ci/locks.py --bill build/wheel
	cd build/wheel && venv/bin/magtwin demo --out demo && venv/bin/magtwin info demo/run.parquet

schema: $(VENV)/.dev  ## Generate the schema library anew from schema.usda
	$(BIN)/python magtwin/usd/schema/generate.py

assets: $(VENV)/.dev  ## Build robots/, maps/, weights/ and scenes/ anew
	$(BIN)/python robots/turtlebot4/build.py
	$(BIN)/python maps/lab/build.py
	$(BIN)/python scenes/build.py  # names the new map; its network is the old one until the last line
	rm -rf build/paper/lab && $(BIN)/python weights/protocol.py --out build/paper/lab --ship
	rm -rf build/paper/mixed && $(BIN)/python weights/mixed.py --out build/paper/mixed --ship
	$(BIN)/python scenes/build.py

pictures: $(VENV)/.installed build/blender/.installed  ## Draw the pictures of README and docs again (needs npm and chromium)
	$(BIN)/magtwin plot scenes/lab/lab.usda --out docs/lab.png --force
	$(BIN)/magtwin plot robots/turtlebot4/turtlebot4.usda --size 1100x900 --out docs/robot.png --force
	$(BIN)/magtwin plot maps/lab/lab.usdc --out docs/map.png --force
	$(BIN)/magtwin run scenes/lab/lab.usda --out build/pictures --force
	$(BIN)/magtwin plot build/pictures/run.rrd --at 35 --size 1600x900 --out docs/recording.png --force
	$(BIN)/magtwin report build/pictures/run.parquet --out build/pictures/run.html --force
	$(BIN)/python docs/page_film.py build/pictures/run.html docs/page.gif docs/page.png
	$(BIN)/magtwin plot build/pictures/run.parquet --camera 0.4,-1.6,6.1:0.4,-0.2,0 --size 560x350 --pace 10 --fps 8 --out docs/run.gif --force
	$(BIN)/python docs/python.py
	$(BIN)/python docs/load.py
	MAGTWIN_BLENDER=$(CURDIR)/build/blender/bin/python $(BIN)/python docs/looks.py

clean:  ## Remove the environment and what was built
	rm -rf $(VENV) build demo

$(BIN)/python:
	@$(PYTHON) -c 'import sys; v = sys.version_info; sys.exit(0 if v >= (3, 11) else f"magtwin needs Python 3.11 or newer, {sys.executable} is {v[0]}.{v[1]}; name another with make PYTHON=...")'
	$(call venv,$(VENV)) || { echo "no venv module: apt-get install python3-venv"; exit 1; }

$(VENV)/.installed: pyproject.toml constraints.txt | $(BIN)/python
	@echo "Installing magtwin and what it needs into $(VENV) (a few minutes, once) ..."
	$(PIP) -e '.[view]'
	@touch $@

$(VENV)/.dev: $(VENV)/.installed
	$(PIP) -e '.[dev]'
	@touch $@

$(VENV)/.physics: pyproject.toml constraints.txt | $(BIN)/python
	$(PIP) -e '.[dev,physics]'
	@touch $(VENV)/.installed $(VENV)/.dev $@
