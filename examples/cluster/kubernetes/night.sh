#!/bin/bash
# Logs -> loop closures on Kubernetes:  bash night.sh [MANIFEST]
# A Job for each stage, one after the other. MANIFEST is the path in the volume.
set -euo pipefail
here=$(cd "$(dirname "$0")" && pwd)
manifest=${1:-/data/drives.csv}

for stage in fuse describe search decide; do
    logs=
    if [ "$stage" = fuse ]; then
        logs="--manifest, $manifest, "
    fi
    sed "s|STAGE|$stage|g; s|args: \[|args: [$logs|" "$here/stage.yaml" | kubectl apply -f -

    # it is over when it is complete, or when an index failed for good
    kubectl wait --for condition=complete --timeout 24h "job/semloc-$stage" &
    complete=$!
    kubectl wait --for condition=failed --timeout 24h "job/semloc-$stage" &
    failed=$!
    wait -n "$complete" "$failed" || true
    kill "$complete" "$failed" 2>/dev/null || true
done
