#!/usr/bin/env bash
# Run a part of the tiny profile through a Slurm of one node, started for this run only, with the cluster profile.
#
#   workflow/try_slurm.sh             the simulated sessions and chapters 1 to 3 of config/smoke.yaml, 16 jobs
#   workflow/try_slurm.sh book        all chapters and the book
#
# Needs `make setup`, and Slurm: on Debian and Ubuntu, as root, it installs slurm-wlm and munge by itself; elsewhere install
# them before. It needs no root otherwise, no systemd, no cgroups and no database: every file of the daemons lies in
# one temporary folder, which goes when they do. Nothing is installed into .venv: the plugin goes into build/slurm.
# Calls may be repeated; what an earlier one finished is not run again. To begin anew: rm -rf build/smoke data/sessions/smoke
set -euo pipefail
cd "$(dirname "$0")/.."

[ $# -gt 0 ] || set -- $(.venv/bin/python - <<'PYTHON'
import sys
sys.path.insert(0, "workflow")
import chapters
config = chapters.load_config("config/smoke.yaml")
print(*(run.path(config["out_dir"]) for run in chapters.all_runs(config) if run.chapter < "04"))
PYTHON
)
plugins=$PWD/build/slurm/plugins
state=
say() { echo "try_slurm: $*"; }
fail() {
    say "$*" >&2
    exit 1
}

install_slurm() {
    local missing=
    for program in slurmctld slurmd sbatch srun squeue munged; do command -v "$program" >/dev/null || missing=yes; done
    if [ -z "$missing" ]; then return; fi
    command -v apt-get >/dev/null || fail "Slurm and munge are missing; install them and call again"
    [ "$(id -u)" = 0 ] || fail "Slurm is missing; as root: apt-get install slurm-wlm munge"
    say "installing slurm-wlm and munge"
    apt-get update -qq
    DEBIAN_FRONTEND=noninteractive apt-get install -qq -y --no-install-recommends slurm-wlm munge >/dev/null
}

install_plugins() {
    local wanted=workflow/profiles/slurm/requirements.txt
    if cmp -s "$wanted" "$plugins/installed.txt"; then return; fi
    say "installing the plugin into build/slurm/plugins"
    rm -rf "$plugins"
    .venv/bin/python -m pip --disable-pip-version-check install -qq --no-deps --target "$plugins" -r "$wanted"
    cp "$wanted" "$plugins/installed.txt"
}

# Two free ports for the two daemons.
free_ports() {
    .venv/bin/python -c 'import socket
held = [socket.create_server(("", 0)) for _ in range(2)]
print(*(one.getsockname()[1] for one in held))'
}

configure() {
    local cores memory ports
    cores=$(nproc)
    memory=$(awk '/^MemTotal/ {print int($2 / 1024)}' /proc/meminfo)
    read -r -a ports < <(free_ports)
    cat >"$state/slurm.conf" <<CONFIGURATION
ClusterName=radar-on-lidar
SlurmctldHost=$(hostname -s)(127.0.0.1)
SlurmctldPort=${ports[0]}
SlurmdPort=${ports[1]}
SlurmUser=$(id -un)
SlurmdUser=$(id -un)
AuthType=auth/munge
AuthInfo=socket=$state/munge.socket
StateSaveLocation=$state/slurmctld
SlurmdSpoolDir=$state/slurmd
SlurmctldPidFile=$state/slurmctld.pid
SlurmdPidFile=$state/slurmd.pid
SlurmctldLogFile=$state/slurmctld.log
SlurmdLogFile=$state/slurmd.log
# No cgroups, no database: processes are found through /proc, finished jobs are remembered by the controller for a day.
ProctrackType=proctrack/linuxproc
TaskPlugin=task/none
JobAcctGatherType=jobacct_gather/linux
JobAcctGatherFrequency=task=2
AccountingStorageType=accounting_storage/none
MinJobAge=86400
JobCompType=jobcomp/none
SwitchType=switch/none
MpiDefault=none
ReturnToService=2
SelectType=select/cons_tres
SelectTypeParameters=CR_CPU_Memory
SlurmdParameters=config_overrides
NodeName=$(hostname -s) NodeAddr=127.0.0.1 CPUs=$cores RealMemory=$memory State=UNKNOWN
PartitionName=book Nodes=ALL Default=YES MaxTime=INFINITE State=UP
CONFIGURATION
}

versions() {
    echo "$(sinfo --version), $(sed -n 's/^\(snakemake.*\)==/\1 /p' "$plugins/installed.txt" | paste -sd , | sed 's/,/, /g'), snakemake $(.venv/bin/snakemake --version)"
}

# Each job: state, cores, memory asked for, time, and the rule with its session.
table() {
    echo "job  state      cores  memory      time  rule"
    squeue --states=all --sort=i --noheader --format="%i %T %C %m %M %k" |
        while read -r job state cores memory time rule; do
            rule=${rule#rule_}
            printf '%-4s %-10s %5s %7s %9s  %s\n' "$job" "$state" "$cores" "$memory" "$time" "${rule/_wildcards_/, }"
        done
}

stop() {
    local status=$? name
    trap - EXIT
    if [ -n "$state" ]; then
        if [ $status != 0 ]; then table >&2 || true; fi
        for name in slurmd slurmctld munged; do
            if [ -s "$state/$name.pid" ]; then kill "$(cat "$state/$name.pid")" 2>/dev/null || true; fi
        done
        if [ $status != 0 ]; then
            say "failed; the ends of the daemons' logs:" >&2
            tail -n 5 "$state"/*.log >&2 || true
        fi
        sleep 2
        rm -rf "$state"
        say "daemons stopped, their files removed"
    fi
    exit $status
}

start() {
    state=$(mktemp -d)
    chmod 755 "$state" # munge wants that nobody else can write there
    trap stop EXIT
    trap 'exit 130' INT TERM
    mkdir -p "$state/slurmctld" "$state/slurmd"
    configure
    export SLURM_CONF=$state/slurm.conf
    (umask 077 && dd if=/dev/urandom bs=1024 count=1 of="$state/munge.key" status=none)
    munged --force --key-file="$state/munge.key" --socket="$state/munge.socket" --pid-file="$state/munged.pid" \
        --log-file="$state/munged.log" --seed-file="$state/munge.seed"
    # The plugin starts each job by srun without any SLURM_CONF, as srun finds its configuration in /etc on a real cluster.
    mkdir "$state/bin"
    printf '#!/bin/sh\nSLURM_CONF=%s exec %s "$@"\n' "$SLURM_CONF" "$(command -v srun)" >"$state/bin/srun"
    chmod 755 "$state/bin/srun"
    export PATH=$state/bin:$PATH
    slurmctld
    slurmd
    for _ in $(seq 30); do
        if [ "$(sinfo --noheader --format=%t 2>/dev/null)" = idle ]; then return; fi
        sleep 1
    done
    fail "the node did not come up"
}

[ -x .venv/bin/snakemake ] || fail "no .venv; run: make setup"
install_slurm
install_plugins
start
say "$(versions)"
sinfo --long
started=$(date +%s)
# Beside the profile: what this small Slurm differs in. It has no accounting, so states come from squeue, and nobody minds if
# it is asked often.
PYTHONPATH=$plugins .venv/bin/snakemake --profile workflow/profiles/slurm --configfile config/smoke.yaml \
    --slurm-status-command squeue --slurm-init-seconds-before-status-checks 5 --quiet host reason -- "$@"
{
    echo "$(date -u +%Y-%m-%d): $(versions)"
    echo "one node: $(sinfo --noheader --format='%c cores, %m MB')"
    echo
    table
    echo
    echo "all done after $(($(date +%s) - started)) s"
} | tee build/slurm/run.txt
say "the same is kept in build/slurm/run.txt"
