#!/bin/bash
# A sweep on the machines of one SLURM job: Ray is started on all of them, cfb sweep on the first.
#
#   sbatch --nodes=4 --cpus-per-task=32 scripts/slurm_sweep.sh CONFIG DIR [more options of cfb sweep]
#
# CONFIG, DIR and the folder you submit from must lie on a file system that all machines share, and cfb and ray must be
# on the PATH there: activate the virtual environment before sbatch, which hands its environment on. Submitted again,
# the sweep goes on where it was, so a job that runs into its time limit loses nothing that has landed.
# Needs Ray 2.50 or newer (symmetric-run), which at the end stops every Ray of yours on these machines. docs/sweeps.md
# has the way without a cluster, by a job array.
#SBATCH --job-name=cfb-sweep
#SBATCH --nodes=1
#SBATCH --ntasks-per-node=1
#SBATCH --cpus-per-task=4
#SBATCH --time=04:00:00
set -euo pipefail

if [ $# -lt 2 ]; then
  echo "usage: sbatch [--nodes=N --cpus-per-task=N --gpus-per-node=N ...] $0 CONFIG DIR [OPTIONS]" >&2
  exit 2
fi
config=$1
folder=$2
shift 2

head=$(scontrol show hostnames "$SLURM_JOB_NODELIST" | head -n 1)
# Of this job alone: others may run on the same machines.
port=$((20000 + SLURM_JOB_ID % 20000))
export RAY_USAGE_STATS_ENABLED=0
# Whoever reaches Ray's ports runs what they like; newer versions of Ray can ask for a token.
export RAY_AUTH_MODE=token
RAY_AUTH_TOKEN=$(od -An -N32 -tx1 /dev/urandom | tr -d ' \n')
export RAY_AUTH_TOKEN

# Not by its name `ray symmetric-run`: Ray 2.50 and 2.51 take that for an argument.
srun --nodes="$SLURM_JOB_NUM_NODES" --ntasks="$SLURM_JOB_NUM_NODES" --ntasks-per-node=1 \
  python -m ray.scripts.symmetric_run --address "$head:$port" --min-nodes "$SLURM_JOB_NUM_NODES" \
  --num-cpus "$SLURM_CPUS_PER_TASK" --include-dashboard false -- \
  cfb sweep "$config" -o "$folder" --address "$head:$port" "$@"
