#!/bin/bash
# On every machine, with its own number; the first is number 0, and its address is reachable from all:
#   COORDINATOR=node1:29400 PROCESSES=2 PROCESS=0 experiments/launch/by_hand.sh --stage 1 --data data.parquet --run /shared/run
# Without PROCESS all of them run here, one CPU device each: to try a run of several processes on one machine.
set -eu
export JAX_COORDINATOR_ADDRESS="${COORDINATOR:-localhost:29400}" JAX_NUM_PROCESSES="${PROCESSES:-2}"
anytouch="${ANYTOUCH:-.venv/bin/anytouch}"
if [ -n "${PROCESS:-}" ]; then
    JAX_PROCESS_ID="$PROCESS" exec "$anytouch" train "$@"
fi
export JAX_PLATFORMS=cpu
for ((process = 0; process < JAX_NUM_PROCESSES; process++)); do
    JAX_PROCESS_ID="$process" "$anytouch" train "$@" &
done
trap 'told=1; kill -TERM $(jobs -pr) 2>/dev/null' TERM  # they save, and end
trap 'told=1; kill -INT $(jobs -pr) 2>/dev/null' INT
status=0 told=
while [ -n "$(jobs -pr)" ]; do
    code=0
    wait -n || code=$?
    if [ -n "$told" ]; then told=; else status=$((status ? status : code)); fi  # a signal ends the waiting, not a process
done
exit "$status"
