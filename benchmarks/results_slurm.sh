#!/bin/bash
# A sweep on a two-node Slurm on this very machine: one node killed in mid-sweep, one waiting job cancelled; then the
# same command again. Root, and a script that starts such a Slurm (start DIR, stop DIR, configuration in DIR/slurm.conf):
#
#     benchmarks/results_slurm.sh ../shared/tools/slurm_local.sh /tmp/slurm
set -eu
tool=$(realpath "$1") dir=$2
"$tool" start "$dir"
trap '"$tool" stop "$dir"' EXIT
export SLURM_CONF=$dir/slurm.conf PATH=$dir/bin:$PATH

sweep() {
    status=0
    python -m ssm_study.cli run -m experiment=smoke 'seed=range(6)' hydra/launcher=slurm hydra.launcher.partition=debug \
        "results_dir=$dir/results" >>"$dir/sweep.log" 2>&1 || status=$?
    echo "exit status $status"
    python -m ssm_study.cli show "$dir/results/smoke" | grep -E -A9 '^[0-9]+ runs'
}
on_node() { # every process that Slurm has started there, and the one that would tell of their end
    started=$(grep -lz "^SLURMD_NODENAME=$1\$" /proc/[0-9]*/environ 2>/dev/null | cut -d/ -f3)
    ps -o ppid=,comm= -p "$(echo $started | tr ' ' ,)" | while read -r parent _; do
        if [ "$(cat "/proc/$parent/comm")" = slurmstepd ]; then echo "$parent"; fi
    done
    echo "$started"
}

sweep &
until [ "$(squeue -h -t R | wc -l)" = 2 ]; do sleep 1; done
sleep 6
cancelled=$(squeue -h -r -t PD -o %i | tail -1)
scancel "$cancelled"
echo "cancelled while waiting: $cancelled; killed with node n2: $(squeue -h -w n2 -o %i)"
kill -9 "$(cat "$dir/slurmd.n2.pid")" $(on_node n2)
(sleep 45 && setsid slurmd -D -N n2 >>"$dir/log/n2.out" 2>&1) & # after Slurm has noticed, the node comes back
wait %1
echo '-- the same command again'
sweep
