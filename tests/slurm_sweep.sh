#!/usr/bin/env bash
# A sweep of 24 jobs through a real Slurm of one node: job 0 runs out of time and queues again, job 1 is killed with
# SIGKILL and is queued again; both go on from their checkpoints and end with the bits of uninterrupted runs.
# Debian, as root, with the extra `slurm` installed; about ten minutes on two cores.
#   tests/slurm_sweep.sh DIR      DIR: for Slurm and the runs
set -euo pipefail
dir=$(mkdir -p "${1:?usage: slurm_sweep.sh DIR}" && realpath "$1")
cd "$(dirname "$0")/.."
sweep=$dir/sweep
rm -rf "$sweep" "$dir/alone"

eval "$(tests/slurm_onebox.sh start "$dir/slurm")"
trap 'tests/slurm_onebox.sh stop "$dir/slurm"' EXIT

settings=(experience.n_episodes=200 learner.n_bias=1 evaluation.every=1000000 evaluation.pictures=false
  checkpoint_every=5)
epochs=(15000 2500 $(seq 101 122))
python train.py -m hydra/launcher=submitit_slurm hydra.launcher.timeout_min=2 hydra.launcher.signal_delay_s=60 \
  "hydra.sweep.dir=$sweep" "learner.n_epochs=$(IFS=,; echo "${epochs[*]}")" "${settings[@]}" >"$dir/sweep.log" 2>&1 &
sweeping=$!

# The process of job 1, once it has a checkpoint.
until compgen -G "$sweep/001-*/checkpoints/*.ckpt" >/dev/null; do sleep 0.2; done
for pid in $(pgrep python); do
  grep -qzx SLURM_ARRAY_TASK_ID=1 "/proc/$pid/environ" 2>/dev/null || continue
  kill -9 "$pid"
  echo "job 1 (process $pid) killed"
done

code=0
wait $sweeping || code=$?
tail -n 30 "$dir/sweep.log"
[ $code = 0 ]

grep -h "Requeued\|timed-out\|CANCELLED" "$sweep"/.submitit/*/*.err
grep -q "this job is timed-out" "$sweep"/.submitit/*_0/*.err
[ "$(grep -c '"status": "completed"' "$sweep/sweep.json")" = 24 ]
for job in 0 1; do
  python train.py "hydra.run.dir=$dir/alone/$job" "learner.n_epochs=${epochs[job]}" "${settings[@]}" >"$dir/alone.log" 2>&1
  cmp "$dir/alone/$job/solution.npz" "$sweep"/00$job-*/solution.npz
done
[ -z "$(find "$sweep" -name "*.ckpt" -o -name "*.tmp")" ]
echo "24 jobs completed; jobs 0 and 1 are the bits of uninterrupted runs"
