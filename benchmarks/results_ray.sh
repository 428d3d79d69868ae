#!/bin/bash
# A sweep on a two-node Ray inside namespaces with nothing but loopback (Ray listens on every interface) and nobody
# else's processes: the second node is killed in mid-sweep; then the same command again. Root; extra `ray`:
#
#     unshare --net --pid --fork --mount-proc --kill-child benchmarks/results_ray.sh /tmp/ray
set -eu
dir=$1
mkdir -p "$dir"
ip link set lo up
for n in 1 2; do ip addr add "10.99.0.$n/32" dev lo; done
export RAY_AUTH_MODE=token RAY_USAGE_STATS_ENABLED=0
RAY_AUTH_TOKEN=$(od -An -N32 -tx1 /dev/urandom | tr -d ' \n')
export RAY_AUTH_TOKEN
node() { # number, further options
    ray start --node-ip-address="10.99.0.$1" --num-cpus=1 --object-store-memory=100000000 --min-worker-port="20${1}00" \
        --max-worker-port="20${1}50" "${@:2}" >>"$dir/ray.log" 2>&1
}
node 1 --head --port=6399 --include-dashboard=false
node 2 --address=10.99.0.1:6399

sweep() {
    status=0
    python -m ssm_study.cli run -m experiment=smoke 'seed=range(6)' hydra/launcher=ray \
        hydra.launcher.ray.init.address=10.99.0.1:6399 ++hydra.launcher.ray.init.object_store_memory=null \
        +hydra.launcher.ray.remote.num_cpus=1 \
        "results_dir=$dir/results" >>"$dir/sweep.log" 2>&1 || status=$?
    echo "exit status $status"
    python -m ssm_study.cli show "$dir/results/smoke" | grep -E -A9 '^[0-9]+ runs'
}

sweep &
until [ "$(grep -ls '"status": "running"' "$dir"/results/smoke/*/record.json | wc -l)" = 2 ]; do
    sleep 0.1
    kill -0 %1 2>/dev/null || exit 1 # the sweep has ended before two jobs were seen at work
done
kill -9 $(pgrep -f "raylet.*--node_ip_address=10.99.0.2")
echo 'killed node 2'
wait %1
echo '-- the same command again'
sweep
