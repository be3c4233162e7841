#!/usr/bin/env bash
# Train each capture of a folder as a task of a Slurm array. docs/batch.md says how to call it.
#SBATCH --job-name=refgs
#SBATCH --cpus-per-task=1
#SBATCH --mem=2G
#SBATCH --requeue
#SBATCH --open-mode=append
set -u

captures=$1 runs=$2
shift 2  # the rest are options of `refgs train`
capture=$(find "$captures" -mindepth 1 -maxdepth 1 -type d -not -name '.*' | LC_ALL=C sort | sed -n "${SLURM_ARRAY_TASK_ID}p")
run=$runs/$(basename "$capture")
export OMP_NUM_THREADS=${SLURM_CPUS_PER_TASK:-1}

# Run a step. Pass SIGTERM on to it, so that a training writes a checkpoint. If it says "try again", queue the task again.
step() {
  local child status
  refgs "$@" --once &
  child=$!
  trap 'kill -TERM "$child"' TERM
  wait "$child"
  status=$?
  while kill -0 "$child" 2>/dev/null; do  # the trap has ended the wait
    wait "$child"
    status=$?
  done
  trap - TERM
  if [ "$status" -eq 75 ] && [ "${SLURM_RESTART_COUNT:-0}" -lt 5 ]; then
    scontrol requeue "$SLURM_JOB_ID"
    exit 75
  fi
  return "$status"
}

step poses "$capture" || exit
step masks "$capture" || true  # without masks, all that the photos show is trained
step train "$capture" --out "$run" "$@" || exit
step evaluate "$run" || true
step export "$run" || exit
