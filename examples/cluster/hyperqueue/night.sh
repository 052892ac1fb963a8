#!/bin/bash
# Logs -> loop closures with HyperQueue:  bash night.sh MANIFEST WORK
# One task of HyperQueue for each task of a stage; it gives them to free workers.
set -euo pipefail
MANIFEST=$(realpath "$1")
WORK=$(realpath -m "$2")

for stage in fuse describe search decide; do
    logs=
    if [ "$stage" = fuse ]; then
        logs="--manifest '$MANIFEST'"
    fi
    count=$(eval "semloc tasks $stage -w '$WORK' $logs --count")
    # a log that cannot be fused does not stop the others; decide wants every pair
    hq submit --wait --name "semloc-$stage" --cpus 1 --array "0-$((count - 1))" --crash-limit 5 -- \
        bash -c "exec semloc task $stage -w '$WORK' $logs --index \"\$HQ_TASK_ID\"" || true
done
