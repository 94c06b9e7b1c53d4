# Every target sets up ./.venv by itself. Needed from the system: make and Python 3.11 or newer.
# Another interpreter: make setup PYTHON=python3.12        Options for a command: make test ARGS="-k brake"
# `make demo` installs what the demo needs, the other targets everything.

PYTHON ?= python3
EXTRAS ?= all,dev
DEMO_EXTRAS ?= brick,sim
ARGS ?=
SECONDS ?= 60
MINUTES ?= 60
OUTPUT ?= runs/flywheel
BIN := .venv/bin
COMMA := ,
READY := .venv/.ready-$(subst $(COMMA),-,$(EXTRAS))
DEMO_READY := .venv/.ready-$(subst $(COMMA),-,$(DEMO_EXTRAS))
SUITE := not slow and not models and not ros2 and not rclpy and not franka and not rivals and not clients
WHICH := not long
# Real arms brake when their computer stands still for a tenth of a second, and so do those of the tests: one that
# fails in real time is tried twice more, and told in the summary.
AGAIN := --reruns 2 -r fEsR
# What fails then is tried once more at the end, when whatever kept the computer busy may be over.
AT_THE_END := --last-failed --last-failed-no-failures none --reruns 0 -r fEs
# Where a container forbids Python to keep what it has compiled, every process of every test would compile it anew.
export PYTHONDONTWRITEBYTECODE :=

.DEFAULT_GOAL := help
.PHONY: help setup demo test test-computed test-realtime test-long slow fuzz fuzz-motion mutants soak soak-fleet test-ros2 test-franka test-rivals demo-rivals test-clients test-realsense test-models check format bench flywheel bench-faults bench-ros2 bench-rclpy build docs ros2-bridge ros2-environment clean

help: ## Show this list
	@grep -hE '^[a-z0-9-]+:.*## ' $(MAKEFILE_LIST) | sed -E 's/^([a-z0-9-]+):.*## (.*)/  make \1\t\2/' | expand -t 20

setup: $(READY) ## Make ./.venv with everything in it

$(READY): pyproject.toml constraints.txt scripts/bootstrap.py $(wildcard plugins/*/pyproject.toml)
	@$(PYTHON) scripts/bootstrap.py $(EXTRAS)
	@touch $@

$(DEMO_READY): pyproject.toml constraints.txt scripts/bootstrap.py $(wildcard plugins/*/pyproject.toml)
	@$(PYTHON) scripts/bootstrap.py $(DEMO_EXTRAS)
	@touch $@

# Nothing to install where everything is there already.
demo: $(if $(wildcard $(READY)),$(READY),$(DEMO_READY)) ## Simulator, model and command node at work, no GPU needed
	$(BIN)/vla-zenoh demo $(ARGS)

# Tests in real time mostly wait. Those that compute run beside them and give way to them, so that both are over in the time
# of one; each shows what it has to say when it is over. In real time run two files at once, with four cores three, of which
# one, with four cores two, are of whole robots (conftest.py); of the rest as many as there are cores, in order of the
# folders: the long files of tests/sim are not the last ones. A process of theirs that dies ends the run: whoever is to take
# its place waits for its files for ever. 5 is pytest's word for "none of these".
ROWS := $(if $(filter 1 2 3,$(shell getconf _NPROCESSORS_ONLN)),2,3)
FILES := --max-worker-restart 0 --dist loadfile --no-loadscope-reorder
REALTIME := -o cache_dir=.pytest_cache/realtime -m "$(SUITE) and $(WHICH) and realtime" $(ARGS)
AT_THE_END_OF_EACH := $(if $(filter output-sync,$(.FEATURES)),--output-sync=target)
test: $(READY) ## Run the tests that take up to six seconds each
	@$(MAKE) --no-print-directory --keep-going --jobs 2 $(AT_THE_END_OF_EACH) test-realtime test-computed

# Two processes on two cores: threads of NumPy's library would only wait for each other.
test-computed: export OMP_NUM_THREADS := 1
test-computed: $(READY)
	nice -n 10 $(BIN)/python -m pytest -n auto $(FILES) -m "$(SUITE) and $(WHICH) and not realtime" $(ARGS) || [ $$? = 5 ]

test-realtime: $(READY)
	$(BIN)/python -m pytest -n $(ROWS) $(FILES) $(AGAIN) $(REALTIME) || [ $$? = 5 ] || \
		$(BIN)/python -m pytest $(AT_THE_END) $(REALTIME)

test-long: $(READY) ## Run those that take longer, too, and the files of many whole robots
	@$(MAKE) --no-print-directory test WHICH=long

slow: $(READY) ## Run the tests that take long, too, and search for new examples
	HYPOTHESIS_PROFILE=searching $(BIN)/python -m pytest -m "not models and not franka and not rclpy and not rivals and not clients" $(ARGS)

fuzz: $(READY) ## Feed every reader of foreign bytes with nonsense; SECONDS=600 for longer
	$(BIN)/python tests/fuzz/fuzz.py --seconds $(SECONDS) $(ARGS)

fuzz-motion: $(READY) ## Fuzz command node and guard with a perfect arm; MINUTES=10 for less
	PYTHONPATH=tests $(BIN)/python tests/fuzz_motion/fuzz_motion.py --minutes $(MINUTES) $(ARGS)

mutants: $(READY) ## Put 200 small faults into the core, one at a time, and tell which no test notices
	$(BIN)/python tests/mutants/mutants.py $(ARGS)

soak: $(READY) ## Run the whole chain with random faults; MINUTES=3 for a short one
	$(BIN)/python reliability/soak/soak.py --minutes $(MINUTES) $(ARGS)

soak-fleet: $(READY) ## Run eight robots, an obeyed model and two in shadow with random faults; MINUTES=3 for a short one
	$(BIN)/python reliability/soak/fleet.py --minutes $(MINUTES) $(ARGS)

# Of ROS 2 itself the distribution jazzy and what is quick; everything with ALL=1.
DISTRIBUTIONS := jazzy $(if $(ALL),kilted)
RCLPY := rclpy$(if $(ALL),, and not slow)
IN_ROS2 := $(or $(ARGS),tests/ros2)
test-ros2: $(READY) ros2-bridge ros2-environment ## Run the tests with a real ROS 2 bridge, a DDS robot and ROS 2's rclpy; ALL=1 for all
	$(BIN)/python -m pytest $(AGAIN) -m ros2 $(IN_ROS2) || [ $$? = 5 ] || \
		$(BIN)/python -m pytest $(AT_THE_END) -m ros2 $(IN_ROS2)
	ROS2_DISTRIBUTIONS="$(DISTRIBUTIONS)" $(BIN)/python -m pytest $(AGAIN) -m "$(RCLPY)" $(IN_ROS2) || [ $$? = 5 ] || \
		ROS2_DISTRIBUTIONS="$(DISTRIBUTIONS)" $(BIN)/python -m pytest $(AT_THE_END) -m "$(RCLPY)" $(IN_ROS2)

test-franka: $(READY) ## Run the tests of the driver franka against franka-sim, in an environment of its own
	$(BIN)/python scripts/test_franka.py $(AGAIN) $(ARGS) || $(BIN)/python scripts/test_franka.py $(AT_THE_END) $(ARGS)

RIVALS := $(if $(ONLY),--only $(ONLY))
test-rivals: $(READY) ## Run the tests against robots' packages of others on Zenoh, each in an environment of its own; ONLY=r2c,trossen
	$(BIN)/python scripts/test_rivals.py $(RIVALS) $(AGAIN) $(ARGS) || $(BIN)/python scripts/test_rivals.py $(RIVALS) $(AT_THE_END) $(ARGS)

demo-rivals: $(READY) ## Two other makers' robots on one bus, an agent, a cut link; log and pictures into runs/rivals
	$(BIN)/python scripts/test_rivals.py --demonstration runs/rivals

test-clients: $(READY) ## Build the clients of the wire in Rust and run their tests; needs cargo
	cargo test --release --manifest-path examples/wire/rust/Cargo.toml
	cargo build --release --manifest-path examples/wire/rust/Cargo.toml
	$(BIN)/python -m pytest $(AGAIN) -m clients tests/wire $(ARGS)

test-realsense: $(READY) ## Run the tests of RealSense cameras with the SDK's software device
	$(BIN)/uv pip install --quiet --no-deps --target .venv/realsense pyrealsense2
	PYTHONPATH=.venv/realsense $(BIN)/python -m pytest tests/unit/nodes/test_realsense.py $(ARGS)

test-models: $(READY) ## Run the tests of OpenVLA and LeRobot, each in its environment (12 GB, once)
	$(BIN)/python scripts/test_models.py $(ARGS)

# Without a cache: ruff's does not notice a module of ours that is gone.
check: $(READY) ## Lint, format and types, as CI does
	$(BIN)/ruff check --no-cache .
	$(BIN)/ruff format --check .
	$(BIN)/basedpyright

format: $(READY) ## Let ruff put files into shape
	$(BIN)/ruff check --fix .
	$(BIN)/ruff format .

bench: $(READY) ## Measure camera to command on this machine
	$(BIN)/python -m benchmarks chain $(ARGS)

flywheel: $(READY) ## Meta-World's expert to a policy and its tables, hours on a CPU; OUTPUT=runs/flywheel, goes on there
	$(BIN)/python -m benchmarks flywheel -o $(OUTPUT) $(ARGS)

bench-faults: $(READY) ## Faults of a lab network on an arm in motion (root), table into docs/explanation/reliability.md
	$(BIN)/python reliability/netns/bench_faults.py $(ARGS)

bench-ros2: $(READY) ros2-bridge ## Measure a picture's way to a pose through ROS 2
	$(BIN)/python tests/ros2/bench.py $(ARGS)

bench-rclpy: $(READY) ros2-bridge ros2-environment ## Measure exactness, latency, stops and faults with an rclpy robot
	$(BIN)/python tests/ros2/bench_rclpy.py $(ARGS)

build: $(READY) ## Build wheel and sdist into dist/ and try each in an empty environment
	$(BIN)/python scripts/check_wheel.py $(ARGS)

docs: $(READY) ## Make the reference pages from the code, and the site into site/; ARGS=serve to look at it
	$(BIN)/uv --quiet pip install --python $(BIN)/python -c constraints.txt -e '.[docs]'
	$(BIN)/python scripts/reference.py
	NO_MKDOCS_2_WARNING=1 $(BIN)/mkdocs $(or $(ARGS),build --strict --quiet)

ros2-bridge: ## Build a zenoh-bridge-ros2dds for the tests, once, unless PATH has one
	@$(PYTHON) scripts/ros2_bridge.py

ros2-environment: $(READY) ## Make an environment with ROS 2's rclpy for the tests, once
	@$(BIN)/python scripts/ros2_environment.py $(DISTRIBUTIONS)

clean: ## Remove everything these targets made
	rm -rf .venv .tools dist site .pytest_cache .ruff_cache .hypothesis
	find . -name __pycache__ -type d -prune -exec rm -rf {} +
