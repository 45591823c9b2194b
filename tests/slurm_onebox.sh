#!/usr/bin/env bash
# A Slurm cluster of this one machine, on loopback, to try hydra/launcher=submitit_slurm on. Debian, as root.
#   eval "$(tests/slurm_onebox.sh start DIR)"      DIR keeps its configuration, state and logs
#   tests/slurm_onebox.sh stop DIR
set -euo pipefail
usage="usage: slurm_onebox.sh start|stop DIR"
action=${1:?$usage}
mkdir -p "${2:?$usage}"
dir=$(realpath "$2")
host=$(hostname -s)
export SLURM_CONF=$dir/slurm.conf

running() { [ -s "$1" ] && kill -0 "$(cat "$1")" 2>/dev/null; }

start() {
  for program in slurmctld slurmd munged; do
    [ -n "$(PATH=$PATH:/usr/sbin command -v $program)" ] && continue
    apt-get install -y -q --no-install-recommends slurmctld slurmd slurm-client munge
    break
  done
  if ! running /run/munge/munged.pid; then
    install -d -o munge -g munge -m 755 /run/munge
    runuser -u munge -- /usr/sbin/munged
  fi
  mkdir -p "$dir/state" "$dir/spool"
  # No accounting (sacct does not work): the harder case for whoever waits for jobs.
  cat >"$SLURM_CONF" <<END
ClusterName=erl_torch
SlurmctldHost=$host(127.0.0.1)
NodeName=$host NodeAddr=127.0.0.1 CPUs=$(nproc) RealMemory=$(awk '/^MemTotal/ {print int($2 / 1280)}' /proc/meminfo)
PartitionName=all Nodes=$host Default=YES MaxTime=INFINITE
CommunicationParameters=NoCtldInAddrAny,NoInAddrAny
SlurmUser=root
StateSaveLocation=$dir/state
SlurmdSpoolDir=$dir/spool
SlurmctldPidFile=$dir/slurmctld.pid
SlurmdPidFile=$dir/slurmd.pid
SlurmctldLogFile=$dir/slurmctld.log
SlurmdLogFile=$dir/slurmd.log
SelectType=select/cons_tres
SelectTypeParameters=CR_CPU
ProctrackType=proctrack/linuxproc
TaskPlugin=task/none
MpiDefault=none
JobAcctGatherType=jobacct_gather/none
AccountingStorageType=accounting_storage/none
ReturnToService=2
KillWait=10
END
  slurmctld
  slurmd
  for _ in $(seq 100); do
    [ "$(sinfo --noheader --format=%t 2>/dev/null)" = idle ] && return
    sleep 0.1
  done
  echo "the node does not become idle: see $dir/*.log" >&2
  exit 1
}

case $action in
  start) start >&2 && echo "export SLURM_CONF=$SLURM_CONF" ;;
  stop) for pid in "$dir"/slurmd.pid "$dir"/slurmctld.pid; do ! running "$pid" || kill "$(cat "$pid")"; done ;;
  *) echo "$usage" >&2; exit 2 ;;
esac
