#!/usr/bin/env bash
# A real Slurm of one node, with accounting, for tests: one_node_slurm.sh start|stop FOLDER
#
# As root, with the Debian packages slurm-wlm slurmdbd munge mariadb-server installed. All state lies in
# FOLDER; only the configuration is at its default place, as jobs lose SLURM_CONF. A Slurm that is set
# up already is left alone.
set -euo pipefail

mark="# written by tests/cluster/one_node_slurm.sh"
settings=/etc/slurm
command=${1:?start or stop}
folder=${2:?folder}
mkdir -p "$folder"
folder=$(cd "$folder" && pwd)
node=$(hostname -s)
# nproc counts the threads that OMP_NUM_THREADS allows, where that is set.
cores=$(env -u OMP_NUM_THREADS -u OMP_THREAD_LIMIT nproc)

# Waits for a command to succeed: daemons answer some time after they were started.
wait_for() {
  local tries=0
  until "$@" >>"$folder/wait.log" 2>&1; do
    tries=$((tries + 1))
    if [ "$tries" -ge 100 ]; then
      echo "error: '$*' fails after 100 tries; the daemons' logs are in $folder" >&2
      exit 1
    fi
    sleep 0.2
  done
}

# Starts a daemon in the foreground of a background process, so that its number is known.
launch() {
  local name=$1
  shift
  setsid "$@" >"$folder/$name.log" 2>&1 </dev/null &
  echo $! >"$folder/$name.pid"
}

refuse_foreign() {
  local file
  for file in "$settings/slurm.conf" "$settings/slurmdbd.conf" "$settings/gres.conf"; do
    if [ -e "$file" ] && ! grep -qF "$mark" "$file"; then
      echo "error: $file belongs to another Slurm; this script sets one up on machines without" >&2
      exit 2
    fi
  done
}

write_settings() {
  mkdir -p "$settings" "$folder/spool" "$folder/state"
  cat >"$settings/slurm.conf" <<CONF
$mark
ClusterName=tiny
SlurmctldHost=$node(127.0.0.1)
SlurmUser=root
ProctrackType=proctrack/linuxproc
MpiDefault=none
TaskPlugin=task/none
# Polls the memory of jobs and ends those that take more than they asked for, without control groups.
JobAcctGatherType=jobacct_gather/linux
JobAcctGatherFrequency=task=1
JobAcctGatherParams=OverMemoryKill
SelectType=select/cons_tres
SelectTypeParameters=CR_Core_Memory
SchedulerParameters=batch_sched_delay=0,sched_min_interval=200000,sched_interval=1,bf_interval=1
AccountingStorageType=accounting_storage/slurmdbd
AccountingStorageHost=127.0.0.1
AccountingStorageTRES=gres/gpu
AccountingStoreFlags=job_comment
GresTypes=gpu
StateSaveLocation=$folder/state
SlurmdSpoolDir=$folder/spool
SlurmctldPidFile=$folder/slurmctld.own.pid
SlurmdPidFile=$folder/slurmd.own.pid
KillWait=2
MinJobAge=300
ReturnToService=2
NodeName=$node NodeAddr=127.0.0.1 CPUs=$cores Gres=gpu:1 RealMemory=$(($(awk '/MemTotal/ {print $2}' /proc/meminfo) / 1024 / 2))
PartitionName=main Nodes=$node Default=YES MaxTime=INFINITE State=UP
CONF
  # No GPU is needed to see that a job asks for one.
  printf '%s\nName=gpu File=/dev/null\n' "$mark" >"$settings/gres.conf"
  cat >"$settings/slurmdbd.conf" <<CONF
$mark
DbdHost=$node
DbdAddr=127.0.0.1
SlurmUser=root
StorageType=accounting_storage/mysql
StorageHost=127.0.0.1
StoragePort=33160
StorageUser=slurm
StoragePass=slurm
PidFile=$folder/slurmdbd.own.pid
CONF
  chmod 600 "$settings/slurmdbd.conf"
}

start_munge() {
  # Every part of Slurm would have to be told of another socket than the default one.
  mkdir -p /run/munge "$folder/munge"
  chmod 755 /run/munge
  head -c 128 /dev/urandom >"$folder/munge/key"
  chmod 700 "$folder/munge"
  chmod 400 "$folder/munge/key"
  launch munged munged --foreground --force --key-file="$folder/munge/key" \
    --pid-file="$folder/munge/pid" --seed-file="$folder/munge/seed"
  wait_for munge --no-input
}

start_database() {
  mkdir -p "$folder/database"
  mariadb-install-db --no-defaults --datadir="$folder/database" --user=root --skip-test-db \
    --auth-root-authentication-method=normal >"$folder/install.log" 2>&1
  launch mariadbd mariadbd --no-defaults --user=root --datadir="$folder/database" \
    --socket="$folder/database/socket" --bind-address=127.0.0.1 --port=33160 \
    --innodb-buffer-pool-size=32M --innodb-lock-wait-timeout=900 --innodb-flush-log-at-trx-commit=0
  local query=(mariadb --no-defaults --socket="$folder/database/socket" --execute)
  wait_for "${query[@]}" "select 1"
  "${query[@]}" "create user slurm@'127.0.0.1' identified by 'slurm'; grant all on slurm_acct_db.* to slurm@'127.0.0.1'"
}

start() {
  refuse_foreign
  if scontrol ping >/dev/null 2>&1; then
    echo "error: a Slurm of this script works already: stop that one first" >&2
    exit 2
  fi
  write_settings
  start_munge
  start_database
  launch slurmdbd slurmdbd -D
  wait_for sacctmgr --immediate list cluster
  sacctmgr --immediate --quiet add cluster tiny >>"$folder/wait.log"
  sacctmgr --immediate --quiet add account tests >>"$folder/wait.log"
  sacctmgr --immediate --quiet add user "$(id -un)" account=tests >>"$folder/wait.log"
  launch slurmctld slurmctld -D -c
  wait_for scontrol ping
  launch slurmd slurmd -D
  wait_for sh -c "sinfo --noheader --format=%T | grep -qx idle"
}

stop() {
  local name
  for name in slurmd slurmctld slurmdbd mariadbd munged; do
    if [ -f "$folder/$name.pid" ]; then
      kill "$(cat "$folder/$name.pid")" 2>/dev/null || true
      rm "$folder/$name.pid"
    fi
  done
  refuse_foreign
  rm -f "$settings/slurm.conf" "$settings/slurmdbd.conf" "$settings/gres.conf"
}

case $command in
  start) start ;;
  stop) stop ;;
  *) echo "error: expected start or stop, got $command" >&2 && exit 2 ;;
esac
