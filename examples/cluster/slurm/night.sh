#!/bin/bash
# Logs -> loop closures on a SLURM cluster:  bash night.sh MANIFEST WORK
# Four array jobs, each of which waits for the one before; JOBS is the size of the arrays.
set -euo pipefail
here=$(cd "$(dirname "$0")" && pwd)
MANIFEST=$(realpath "$1")
WORK=$(realpath -m "$2")
export MANIFEST WORK
last=$((${JOBS:-20} - 1))

previous=
for stage in fuse describe search decide; do
    export STAGE=$stage
    # afterany: a log that cannot be fused does not stop the others; decide wants every pair
    previous=$(sbatch --parsable --job-name "semloc-$stage" --export ALL \
        --array "0-$([ "$stage" = decide ] && echo 0 || echo "$last")" \
        ${previous:+--dependency "afterany:$previous"} "$here/stage.sbatch")
    echo "$stage: job $previous"
done
