#!/bin/bash
# sbatch experiments/launch/slurm.sh --stage 1 --data data.parquet --run runs/stage1 --preset large --run.fsdp 8
# One process an accelerator; jax learns from srun where the first one runs. Submit it again to go on with the run.
#SBATCH --job-name=anytouch
#SBATCH --nodes=2
#SBATCH --ntasks-per-node=8
#SBATCH --gres=gpu:8
#SBATCH --cpus-per-task=12
#SBATCH --time=24:00:00
#SBATCH --signal=TERM@120
#SBATCH --requeue
# Two minutes before the time is up every process gets SIGTERM: the run saves, ends with 0, and the next job goes on.
# On CPUs, or with one process a machine: leave out --gres, and set --ntasks-per-node=1 and JAX_LOCAL_DEVICE_IDS.
set -eu
export XLA_PYTHON_CLIENT_MEM_FRACTION="${XLA_PYTHON_CLIENT_MEM_FRACTION:-.92}"
exec srun --kill-on-bad-exit=1 "${ANYTOUCH:-.venv/bin/anytouch}" train "$@"
