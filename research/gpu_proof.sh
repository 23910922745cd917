#!/usr/bin/env bash
# What a GPU's trainings are good for, as JSON in the folder OUT:
#
#     research/gpu_proof.sh OUT [policy] [student] [drives]      # all three if none is named
#
# policy: one of the real car's size, and its INT8 (OUT/policy/run.json). student: distilled from it. drives: how well
# policies of 5 to 320 drives (COUNTS) plan in 40 others, and drive (OUT/drives.json); an hour without a GPU. STEPS of
# the policy's training: ten minutes by default. LEVEL of the worlds: easy by default. What is ended goes on where it was when
# it is run again. Needs `rover` with what [workshop] of pyproject.toml names, and its python3 in the PATH.
set -euo pipefail
out=$1
shift
level=${LEVEL:-easy}
driven=(--worlds 100 -p level "$level")
mkdir -p "$out"
record() { rover world record "$out/drives-$1" --count "$1" --level "$level" > "$out/drives-$1.log"; }

policy() {
  record 128
  rover train "$out/drives-128" "$out/policy.pth" --size full --steps "${STEPS:-20000}" ${DEVICE:+--device "$DEVICE"}
  [ -f "$out/policy/run.json" ] || rover run "$out/policy.pth" "$out/drives-128" --name policy --runs-dir "$out" "${driven[@]}"
}

student() {
  policy
  [ -f "$out/student/distill.json" ] || rover distill "$out/policy.pth" "$out/drives-128" --name student --runs-dir "$out" \
    --size 320x180 --decoder-layers 2 --feedforward 1600 ${DEVICE:+--device "$DEVICE"}
  [ -f "$out/student/run.json" ] || rover run "$out/student/best_model.pth" "$out/drives-128" --name student --runs-dir "$out" \
    "${driven[@]}" -p modes '[static]'
}

drives() {
  [ -d "$out/judges" ] || rover world record "$out/judges" --count 40 --seed 1 --level "$level" > "$out/judges.log"
  counts=${COUNTS:-5 10 20 40 80 160 320}
  for count in $counts; do
    record "$count"
    [ -f "$out/of-$count.pth" ] || rover train "$out/drives-$count" "$out/of-$count.pth" ${DEVICE:+--device "$DEVICE"}
    # A policy of few drives may not be fit to drive, which `rover run` says by its exit code.
    [ -f "$out/of-$count/compare.json" ] || rover run "$out/of-$count.pth" "$out/drives-$count" --name "of-$count" \
      --runs-dir "$out" "${driven[@]}" -p modes '[static]' || [ -f "$out/of-$count/compare.json" ]
  done
  # shellcheck disable=SC2086  # numbers
  python3 - "$out" "$level" $counts << 'END'
import sys
from pathlib import Path
import numpy as np
from rover_learn.lessons import BatchedPolicy, plans_of
from rover_lib.onboard.stage import read_stage, write_stage
from rover_lib.workshop.checkpoint.checkpoint import load_checkpoint
from rover_lib.workshop.recordings.episodes import load_recordings

out, rows = Path(sys.argv[1]), []
judges = load_recordings(out / "judges").samples[::4]
recorded, driven = np.stack([s.chunk for s in judges]), ~np.stack([s.is_pad for s in judges])
for drives in map(int, sys.argv[3:]):
    made = load_checkpoint(out / f"of-{drives}.pth")
    errors = np.abs(plans_of(BatchedPolicy(made.config, made.weights), judges) - recorded)[driven].mean(0)
    errors_pct = dict(zip(made.config.action_names, (100 * errors / np.ptp(recorded[driven], axis=0)).tolist()))
    driven_by = read_stage(out / f"of-{drives}" / "compare.json", "compare")["metrics"]["fp32"]
    rows.append({"drives": drives, "errors_pct": errors_pct, "hits": driven_by["hits"], "trials": driven_by["trials"]})
params = {"level": sys.argv[2], "judges": 40, "judged_on_every": 4, "frames": len(judges)}
write_stage(out / "drives.json", "drives", params=params, metrics={"rows": rows})
END
}

for part in "${@:-policy student drives}"; do
  for each in $part; do "$each"; done
done
