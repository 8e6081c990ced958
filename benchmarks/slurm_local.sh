#!/bin/bash
# A SLURM cluster of this machine alone, for as long as a command runs: munged, slurmctld and slurmd on loopback.
#
#   apt-get install slurm-wlm munge          (Debian, Ubuntu; as root)
#   benchmarks/slurm_local.sh COMMAND ...    the command finds the partition "local" by SLURM_CONF
#
# The exit code is the command's. Everything lies in a temporary folder; nothing in /etc is read or changed.
set -euo pipefail

if [ $# -eq 0 ]; then
    echo "usage: $0 COMMAND ... (runs it beside a SLURM cluster of this machine, partition local)" >&2
    exit 2
fi
for program in munged slurmctld slurmd sbatch; do
    if ! PATH="$PATH:/usr/sbin" command -v "$program" > /dev/null; then
        echo "error: $program is not installed; apt-get install slurm-wlm munge" >&2
        exit 2
    fi
done
export PATH="$PATH:/usr/sbin"

folder=$(mktemp -d /tmp/slurm_local.XXXXXX)
pids=()
end() {
    for pid in "${pids[@]}"; do kill "$pid" 2> /dev/null || true; done
    sleep 1
    for pid in "${pids[@]}"; do kill -9 "$pid" 2> /dev/null || true; done
    if [ -z "${KEEP_SLURM_LOGS:-}" ]; then rm -rf "$folder"; else echo "SLURM's logs: $folder" >&2; fi
}
trap end EXIT

name=$(hostname -s)
cores=$(nproc)
memory_mb=$(awk '/MemTotal/ {print int($2 / 1024 * 0.95)}' /proc/meminfo)
port=$((20000 + RANDOM % 20000))
mkdir -p "$folder"/{state,spool}
head -c 1024 /dev/urandom > "$folder/munge.key"
chmod 600 "$folder/munge.key"
chmod 755 "$folder"

munged --foreground --force --key-file="$folder/munge.key" --socket="$folder/munge.socket" \
    --pid-file="$folder/munged.pid" --log-file="$folder/munged.log" --seed-file="$folder/munged.seed" \
    > "$folder/munged.out" 2>&1 &
pids+=($!)

cat > "$folder/slurm.conf" << END
ClusterName=local
SlurmctldHost=$name(127.0.0.1)
SlurmUser=$(id -un)
SlurmdUser=$(id -un)
SlurmctldPort=$port
SlurmdPort=$((port + 1))
AuthType=auth/munge
AuthInfo=socket=$folder/munge.socket
CredType=cred/munge
StateSaveLocation=$folder/state
SlurmdSpoolDir=$folder/spool
SlurmctldPidFile=$folder/slurmctld.pid
SlurmdPidFile=$folder/slurmd.pid
SlurmctldLogFile=$folder/slurmctld.log
SlurmdLogFile=$folder/slurmd.log
ProctrackType=proctrack/linuxproc
TaskPlugin=task/none
SwitchType=switch/none
MpiDefault=none
SchedulerType=sched/builtin
SelectType=select/cons_tres
SelectTypeParameters=CR_Core
SchedulerParameters=batch_sched_delay=1
ReturnToService=2
JobRequeue=1
NodeName=$name NodeAddr=127.0.0.1 CPUs=$cores RealMemory=$memory_mb State=UNKNOWN
PartitionName=local Nodes=$name Default=YES MaxTime=INFINITE State=UP
END
export SLURM_CONF="$folder/slurm.conf"

for _ in $(seq 50); do [ -S "$folder/munge.socket" ] && break; sleep 0.2; done
slurmctld -D > "$folder/slurmctld.out" 2>&1 &
pids+=($!)
slurmd -D > "$folder/slurmd.out" 2>&1 &
pids+=($!)
for _ in $(seq 100); do
    state=$(sinfo --noheader --format=%T 2> /dev/null || true)
    [ "$state" = idle ] && break
    sleep 0.3
done
if [ "${state:-}" != idle ]; then
    echo "error: the cluster did not start (state: ${state:-none})" >&2
    tail -n 5 "$folder"/*.log "$folder"/*.out >&2 || true
    exit 1
fi
set +e
"$@"
exit $?
