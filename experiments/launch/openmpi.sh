#!/bin/bash
# HOSTS=node1:8,node2:8 PROCESSES=16 experiments/launch/openmpi.sh --stage 1 --data data.parquet --run runs/stage1
# Start it on the first of HOSTS: process 0 runs there. Open MPI 4 and 5; without HOSTS all processes run here.
set -eu
processes="${PROCESSES:-2}" port="${PORT:-29400}"
address="$(hostname):$port"
[ -n "${HOSTS:-}" ] || address="localhost:$port"
# MPI only starts the processes. They communicate by NCCL, or by gloo on CPUs. jax cannot detect Open MPI 5.
numbers='export JAX_NUM_PROCESSES=$OMPI_COMM_WORLD_SIZE JAX_PROCESS_ID=$OMPI_COMM_WORLD_RANK'
numbers="$numbers"' JAX_LOCAL_DEVICE_IDS=$OMPI_COMM_WORLD_LOCAL_RANK; exec "$@"'
exec mpirun -np "$processes" ${HOSTS:+--host "$HOSTS"} --bind-to none \
    -x JAX_COORDINATOR_ADDRESS="$address" -x PATH bash -c "$numbers" - "${ANYTOUCH:-.venv/bin/anytouch}" train "$@"
