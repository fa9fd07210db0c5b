# grnet: `make demo` shows it, `make test` proves it. Everything else is listed by `make help`.
SHELL := /bin/bash
.SHELLFLAGS := -euo pipefail -c
.DEFAULT_GOAL := help

CARGO ?= cargo
export RUSTDOCFLAGS := -D warnings

.PHONY: help
help: ## list the targets
	@awk -F ':.*## ' '/^[a-z-]+:.*## /{printf "  make %-16s %s\n", $$1, $$2}' $(MAKEFILE_LIST)

.PHONY: demo
demo: ## stream the synthetic sequence through the daemon and watch the poses beside ground truth
	@scripts/install-packages build
	@scripts/demo

.PHONY: test
test: ## every default test (no GPU, no network while they run)
	@scripts/install-packages build test
	@scripts/python-venv iceoryx2==0.10.0
	$(CARGO) build --workspace --bins
	@if $(CARGO) nextest --version >/dev/null 2>&1; then \
	  echo "$(CARGO) nextest run --workspace"; $(CARGO) nextest run --workspace --features grnet-capture/conformance; \
	else echo "$(CARGO) test --workspace (install cargo-nextest for a quicker run)"; $(CARGO) test --workspace --lib --bins --tests --features grnet-capture/conformance; fi
	$(CARGO) test --workspace --doc

.PHONY: test-access
test-access: ## who may do what with a stream, by real users (needs root)
	@scripts/install-packages build test
	@scripts/python-venv iceoryx2==0.10.0
	@CARGO='$(CARGO)' scripts/test-access

.PHONY: test-vm
test-vm: ## cameras by a real V4L2 driver in a virtual machine: formats, refusals, unplugging (slow; fetches a kernel once)
	@scripts/install-packages build
	$(CARGO) build --workspace --bins
	$(CARGO) build -p grnet-capture --features conformance --example v4l2_capture
	@tests/vm/run
	@tests/systemd/run camera

.PHONY: test-systemd
test-systemd: ## the Debian package and its units in a booted container: life cycle, access, faults (as root; makes a Debian once)
	@tests/systemd/run

.PHONY: deb
deb: ## Debian packages of the release build, into target/debian (PROFILE=dev: of the build that the tests use)
	@scripts/install-packages build deb
	@scripts/package

.PHONY: lint
lint: ## formatting, clippy, docs, licences, bans and sources of the dependencies
	@scripts/install-packages build
	$(CARGO) fmt --all --check
	$(CARGO) clippy --workspace --all-targets -- -D warnings
	$(CARGO) clippy --workspace --all-targets --features grnet-proto/group-access,grnet-tests/group-access -- -D warnings
	$(CARGO) doc --workspace --no-deps --quiet
	@$(CARGO) deny --version >/dev/null 2>&1 || { echo "installing cargo-deny"; $(CARGO) install cargo-deny --locked --debug --quiet; }
	$(CARGO) deny --log-level error check bans licenses sources

.PHONY: man
man: ## man pages and shell completions, into target/man and target/completions (CARGO_FLAGS=--release reuses a release build)
	@scripts/install-packages build
	$(CARGO) run --quiet $(CARGO_FLAGS) -p grnet-manual -- $${CARGO_TARGET_DIR:-target}

.PHONY: bench
bench: ## criterion benches (long): geometry, preprocessing, network, publish to receive
	@scripts/install-packages build
	$(CARGO) bench --workspace

.PHONY: bench-training
bench-training: ## training steps beside PyTorch's, in turns (long; fetches PyTorch once)
	@scripts/install-packages build
	@scripts/python-venv torch==2.15.0 numpy==2.4.6
	$(CARGO) build --release -p grnet-model --example training_step
	@scripts/bench-training $${CARGO_TARGET_DIR:-target}/release/examples/training_step $${CARGO_TARGET_DIR:-target}/venv/bin/python

.PHONY: relu-start
relu-start: ## a ResNet-50 trained with ReLU as the start of the network, beside drawn weights (long; fetches PyTorch once)
	@scripts/install-packages build
	@scripts/python-venv torch==2.15.0 numpy==2.4.6 pillow==13.0.0 safetensors==0.8.0
	$(CARGO) build --workspace --bins
	@scripts/relu-start $${CARGO_TARGET_DIR:-target}/venv/bin/python

.PHONY: test-cuda
test-cuda: ## operators and networks on an NVIDIA GPU against the CPU and PyTorch (needs the CUDA tool kit)
	@scripts/install-packages build
	$(CARGO) test -p grnet-model --features cuda --test ops --test training -- --include-ignored --test-threads 1
	$(CARGO) test -p grnet-train --features cuda --test cuda -- --include-ignored --test-threads 1

.PHONY: bench-cuda
bench-cuda: ## training and streaming steps on an NVIDIA GPU beside PyTorch's (needs the CUDA tool kit; fetches PyTorch once)
	@scripts/install-packages build
	@scripts/python-venv torch==2.15.0 numpy==2.4.6
	$(CARGO) build --release -p grnet-model --features cuda --example gpu_step
	@scripts/bench-cuda $${CARGO_TARGET_DIR:-target}/release/examples/gpu_step $${CARGO_TARGET_DIR:-target}/venv/bin/python

.PHONY: train-models
train-models: ## the shipped models from nothing (long; goes on where it was stopped)
	@scripts/install-packages build
	$(CARGO) build --workspace --bins
	@scripts/train-models

.PHONY: data-test
data-test: ## the tests that read real recordings; they look in $$GRNET_DATA, else in ../shared/data
	$(CARGO) test --workspace --lib --tests -- --nocapture data_
