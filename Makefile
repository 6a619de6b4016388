# `make demo` and `make test` create the environment they need; see CONTRIBUTING.md.

VENV ?= .venv
ifdef VIEW
TASK ?= HandManipulateBlockRotateZ
endif
TASK ?= FetchReach
EPISODES ?= 5
SECONDS ?= 60

PACKAGES := msgs_spec node_runtime fetch_hand_sim policy_node
PYTHON_FILES := $(PACKAGES) bench docs/conf.py examples test tools setup.py
BIN := $(VENV)/bin
STAMP := $(VENV)/.complete

# The environment contains a ROS of its own: a sourced one, or one that a parent process loaded, must
# not leak in. Some hundred processes share the bytecode.
unexport PYTHONDONTWRITEBYTECODE PYTHONPATH PYTHONHOME AMENT_PREFIX_PATH LD_LIBRARY_PATH _ROS_WHEELS_BOOTSTRAP_COMPLETE

.PHONY: help env demo docs tables pictures test test-alone test-nodes test-others test-the-rest test-browser lint style types format twin bench-sim bench-view bench-camera bench-her bench-paper bench-lockstep bench-rate bench-real-time bench-episodes torture test-release clean distclean

help:
	@echo 'make demo [TASK=$(TASK)] [EPISODES=$(EPISODES)]  run the robot and its actor, log every episode'
	@echo 'make demo VIEW=1 [TASK=...]  the same on a page in the browser, until Ctrl-C'
	@echo 'make test       lint, types and all tests but the long ones'
	@echo 'make test-browser  the page in an installed Chromium'
	@echo 'make lint       ruff and mypy only'
	@echo 'make format     let ruff rewrite the code'
	@echo 'make docs       the documentation as pages: build/docs/index.html'
	@echo 'make tables     the tables of the pages, from the package and the shipped actors'
	@echo 'make pictures   the film of the README and a picture of every task, from logged episodes'
	@echo 'make twin       the long comparison with Gymnasium-Robotics, 20 seeds per task'
	@echo 'make bench-sim  simulation speed against its peers'
	@echo 'make bench-view [SECONDS=$(SECONDS)]  rate of a robot beside viewers'
	@echo 'make bench-camera  CPU time of camera pictures, with and without subscribers'
	@echo 'make bench-her  training speed against Stable-Baselines3'
	@echo 'make bench-paper [TASK=$(TASK)]  four variants x five seeds, as in the figures of the paper'
	@echo 'make bench-lockstep  ticks per second of two nodes against the limit of the middleware'
	@echo 'make bench-real-time  success in real time, with and without answer_wait, against lockstep'
	@echo 'make bench-rate [SECONDS=$(SECONDS)]  rate of joint_states, idle and with all CPUs busy'
	@echo 'make torture    100,000 hostile messages per test, an hour of memory at 20x, 50 killed'
	@echo '                robots, 10,000 damaged episode files'
	@echo 'make test-release  the long tests, also the tutorials and the page in an installed Chromium;'
	@echo '                documentation; wheel and sdist, built, installed elsewhere and used;'
	@echo '                the tests of Gymnasium-Robotics'
	@echo 'make bench-episodes  CPU time of logging, speed of loading'
	@echo 'make env        only create $(VENV)'
	@echo 'make clean      remove build products; distclean removes $(VENV) too'

env: $(STAMP)
	@:

$(STAMP): setup.py setup.cfg constraints.txt tools/make_environment.sh
	@tools/make_environment.sh $(VENV)
	@touch $@

demo: env
ifdef VIEW
	@$(BIN)/python -m fetch_hand_sim view --task $(TASK)
else
	@$(BIN)/python -m fetch_hand_sim demo --task $(TASK) --episodes $(EPISODES)
endif

# Tests that start nodes mostly wait, so five of them share the machine; tests marked `alone` have it for
# themselves. Beside the other tests, which compute, some node tests fail now and then on two cores.
# `--reruns 1`: another process of a shared machine may delay a test by seconds once.
NODE_TESTS := test/nodes test/fetch_hand_sim/replay_node \
	test/fetch_hand_sim/episode_log/test_episode_endings.py \
	test/fetch_hand_sim/episodes/test_episode_recorder.py

test: style
	@$(MAKE) --no-print-directory --keep-going -j1 test-alone test-nodes test-the-rest

# mypy without its cache uses one core for 40 s: beside tests that compute, it costs half of that.
test-the-rest:
	@$(MAKE) --no-print-directory --keep-going -j2 types test-others

test-alone: env
	$(BIN)/python -m pytest -m 'alone and not release' --reruns 1 $(NODE_TESTS)

test-nodes: env
	$(BIN)/python -m pytest -m 'not alone and not release' --reruns 1 -n 5 --dist worksteal $(NODE_TESTS)

test-others: env
	$(BIN)/python -m pytest --reruns 1 -n auto --maxprocesses 4 --dist worksteal $(addprefix --ignore=,$(NODE_TESTS))

lint: style types

style: env
	$(BIN)/python -m ruff check $(PYTHON_FILES)
	$(BIN)/python -m ruff format --check $(PYTHON_FILES)

types: env
	$(BIN)/python -m mypy

test-browser: env
	$(BIN)/python -m pytest -m release test/fetch_hand_sim/view/test_page_in_browser.py

format: env
	$(BIN)/python -m ruff format $(PYTHON_FILES)
	$(BIN)/python -m ruff check --fix $(PYTHON_FILES)

twin: env
	$(BIN)/python -m pytest --twin-seeds 20 --timeout 0 test/fetch_hand_sim/simulation/test_twin.py

docs: env
	$(BIN)/python tools/check_pages.py
	$(BIN)/python -m sphinx -W --keep-going -q -b html docs build/docs
	@echo 'build/docs/index.html'

tables: env
	$(BIN)/python tools/make_tables.py

pictures: env
	$(BIN)/python tools/make_pictures.py

bench-view: env
	$(BIN)/python bench/bench_view.py --seconds $(SECONDS)

bench-camera: env
	$(BIN)/python bench/bench_camera.py

bench-sim: env
	$(BIN)/python bench/bench_sim.py

bench-her: env
	$(BIN)/python -m pip install -q -r bench/requirements_her.txt
	$(BIN)/python bench/bench_her.py

bench-paper: env
	$(BIN)/python -m fetch_hand_sim benchmark --tasks $(TASK)

bench-lockstep: env
	$(BIN)/python bench/bench_lockstep.py

bench-real-time: env
	$(BIN)/python bench/bench_real_time.py

bench-rate: env
	$(BIN)/python bench/bench_rate.py --seconds $(SECONDS)

torture: env
	$(BIN)/python -m pytest -m '' --hostile-messages 100000 --soak-seconds 3600 --timeout 0 \
		test/fetch_hand_sim/sim_node/test_receivers.py \
		test/policy_node/node/test_responder.py test/policy_node/policies/test_hostile_files.py \
		test/nodes/test_nodes_hostile.py
	EPISODE_KILLS=50 EPISODE_LIFE=3 EPISODE_MUTATIONS=10000 $(BIN)/python -m pytest --timeout 0 -s \
		test/fetch_hand_sim/episode_log/test_episode_endings.py \
		test/fetch_hand_sim/episode_log/test_episode_untrusted.py

test-release: env
	$(BIN)/python -m pytest -m 'release and alone' --reruns 1 --timeout 1800 --durations 0
	$(BIN)/python -m pytest -m 'release and not alone' --reruns 1 -n 2 --dist loadfile --timeout 1800 --durations 0
	PYTHON="$$(cd $(BIN) && pwd)/python" tools/test_release.sh

bench-episodes: env
	$(BIN)/python bench/bench_load.py
	$(BIN)/python bench/bench_episode_log.py

clean:
	rm -rf build docs/generated install log *.egg-info .mypy_cache .ruff_cache .pytest_cache
	find $(PYTHON_FILES) -name __pycache__ -prune -exec rm -rf {} +

distclean: clean
	rm -rf $(VENV)
