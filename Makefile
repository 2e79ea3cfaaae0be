# Each target does its own set-up (scripts/setup says what it installs). Steps run one after another, but for some of
# `test`.
SHELL := bash
.SHELLFLAGS := -euo pipefail -c
ifndef SIDE_BY_SIDE
.NOTPARALLEL:
endif
.PHONY: help demo test test-long check after-tests contract objects bench bench-flight bench-link bench-peers bench-serve bench-users bench-wasm setup fmt clippy tests timed doc deny wasm web web-quick web-test scripts

# Mesa's device selection complains where there is no desktop session; there is nothing to select.
export NODEVICE_SELECT := 1

step := scripts/step
target := $(or $(CARGO_TARGET_DIR),target)

help:
	@echo "make demo    a sample scene built, served and drawn (HEADLESS=1: end after the picture)"
	@echo "make web     the viewer for browsers, into target/web, where the server finds it"
	@echo "make test    everything that CI runs"
	@echo "make web-test  the viewer in a headless Chromium, on WebGPU and on WebGL2"
	@echo "make check   formatting and lints only"
	@echo "make bench   benchmarks, with a table at the end"
	@echo "make bench-flight  memory over a flight of ten minutes, and a second session"
	@echo "make bench-link    seconds to a view over slow links, on the DEMs of DIAMANTINA_DATA"
	@echo "make bench-serve   requests a second beside nginx, where it and wrk are installed"
	@echo "make bench-users   1000 users for five minutes, and 2000 idle connections"
	@echo "make test-long     the tests that take too long for each change: every DEM of DIAMANTINA_DATA"
	@echo "make bench-wasm    decoding in the browser's architecture, where it and node are installed"
	@echo "make bench-peers   bytes, bounds and speed beside other codecs, on the DEMs of DIAMANTINA_DATA"

demo:
	@$(step) setup scripts/setup demo
	@$(step) build cargo build --locked --release -p diamantina-server -p diamantina-client
	$(target)/release/diamantina-server demo

test: setup fmt clippy
	@$(MAKE) --no-print-directory --jobs=2 SIDE_BY_SIDE=yes tests web-quick
	@$(MAKE) --no-print-directory timed
	@$(MAKE) --no-print-directory --jobs=2 --output-sync=target SIDE_BY_SIDE=yes web-test after-tests

after-tests: contract objects doc deny wasm scripts

check: fmt clippy

bench:
	@$(step) setup scripts/setup demo
	@scripts/bench
	@echo "Beside other codecs: make bench-peers (first run: an hour and more)"

bench-flight:
	@$(step) setup scripts/setup demo
	@$(step) flight scripts/bench-flight

bench-link:
	@$(step) setup scripts/setup demo
	@$(step) link scripts/bench-link

bench-serve:
	@$(step) setup scripts/setup demo
	@$(step) serve scripts/bench-serve

bench-users:
	@$(step) setup scripts/setup demo
	@$(step) users scripts/bench-users

bench-wasm:
	@$(step) wasm scripts/bench-wasm

bench-peers:
	@$(step) setup scripts/setup demo
	@$(step) build cargo build --locked --release -p diamantina-server -p diamantina-client
	@$(step) peers scripts/bench-peers --speed --tins
	@$(step) views scripts/bench-peers view

setup:
	@$(step) setup scripts/setup test
	@$(step) setup scripts/setup web

fmt:
	@$(step) fmt cargo fmt --all --check

clippy:
	@$(step) clippy cargo clippy --locked --workspace --all-targets -- -D warnings

# With the output of tests that pass: it says which of them had no data to work on. Many wait, for links, ends and
# timeouts, so there are two for each core; those that are held against the clock come afterwards, one by one.
tests:
	@$(step) tests cargo test --locked --workspace --no-fail-fast -- --show-output --test-threads=$$((2 * $$(nproc))) --skip timed::

timed:
	@$(step) timed cargo test --locked --workspace --test e2e -- --show-output --test-threads=1 timed::

# What takes too long for each change. Each DEM is told as it is done.
test-long: setup
	@$(step) long cargo test --locked -p diamantina-tests --test e2e -- --ignored --nocapture

# This and the next after the tests, which have built the programs.
contract:
	@$(step) contract scripts/contract

objects:
	@$(step) objects scripts/objects

doc:
	@RUSTDOCFLAGS="-D warnings" $(step) doc cargo doc --locked --workspace --no-deps

deny:
	@$(step) deny scripts/deny check --hide-inclusion-graph bans licenses sources

wasm:
	@$(step) wasm scripts/wasm

web:
	@$(step) setup scripts/setup web
	@$(step) web scripts/web

# What web-test builds, where it can be built, with what others leave of the processors. It says what it has to say once
# it is done.
web-quick:
	@mkdir -p $(target)
	@status=0; nice -n 19 $(step) web-quick scripts/web-test --build > $(target)/web-quick.log 2>&1 || status=$$?; \
	    cat $(target)/web-quick.log; exit $$status

web-test: setup
	@$(step) web-test scripts/web-test

scripts:
	@$(step) scripts shellcheck .ci/run scripts/bench scripts/bench-flight scripts/bench-link scripts/bench-peers scripts/bench-serve scripts/bench-users scripts/bench-wasm scripts/contract scripts/deny scripts/objects scripts/setup scripts/step scripts/wasm scripts/wasm-cargo scripts/web scripts/web-test
