#!/usr/bin/env bash
# Starts or stops a Slurm that is this machine alone: start_slurm.sh start|stop FOLDER
#
# Needs root and Debian's packages slurm-wlm and munge. FOLDER holds its configuration,
# state and logs; commands find it through SLURM_CONF=FOLDER/slurm.conf.
set -eu

action=$1 folder=$(realpath "$2")

need() {
    command -v "$1" >/dev/null || { echo "$1 is missing: apt-get install slurm-wlm munge" >&2; exit 1; }
}

for program in slurmctld slurmd munged sinfo; do need "$program"; done
[ "$(id -u)" = 0 ] || { echo "slurmd needs root" >&2; exit 1; }
export SLURM_CONF=$folder/slurm.conf

stop() {
    for name in slurmd slurmctld munged; do
        [ -e "$folder/$name.pid" ] && kill "$(cat "$folder/$name.pid")" 2>/dev/null || true
    done
}

if [ "$action" = stop ]; then
    scancel --user="$(id -un)" 2>/dev/null || true
    stop
    exit
fi

mkdir -p "$folder/state" "$folder/spool"
chmod 700 "$folder"
dd if=/dev/urandom of="$folder/munge.key" bs=1024 count=1 status=none
chmod 600 "$folder/munge.key"
# munged wants a socket's folder that all may enter.
sockets=$(mktemp -d)
chmod 755 "$sockets"
munged --force --key-file="$folder/munge.key" --socket="$sockets/munge" \
    --pid-file="$folder/munged.pid" --log-file="$folder/munged.log" \
    --seed-file="$folder/munge.seed"

cat >"$SLURM_CONF" <<CONF
ClusterName=here
SlurmctldHost=$(hostname -s)
SlurmctldPort=26817
SlurmdPort=26818
SlurmUser=root
AuthType=auth/munge
AuthInfo=socket=$sockets/munge
CredType=cred/munge
StateSaveLocation=$folder/state
SlurmdSpoolDir=$folder/spool
SlurmctldPidFile=$folder/slurmctld.pid
SlurmdPidFile=$folder/slurmd.pid
SlurmctldLogFile=$folder/slurmctld.log
SlurmdLogFile=$folder/slurmd.log
ProctrackType=proctrack/pgid
TaskPlugin=task/none
SelectType=select/cons_tres
SelectTypeParameters=CR_Core
JobAcctGatherType=jobacct_gather/none
AccountingStorageType=accounting_storage/none
MpiDefault=none
ReturnToService=2
NodeName=$(hostname -s) CPUs=$(nproc) State=UNKNOWN
PartitionName=all Nodes=ALL Default=YES MaxTime=INFINITE State=UP
CONF

slurmctld
slurmd
for _ in $(seq 30); do
    [ "$(sinfo --noheader --format=%T 2>/dev/null)" = idle ] && exit
    sleep 1
done
stop
echo "no node became idle; see $folder/slurmctld.log and $folder/slurmd.log" >&2
exit 1
