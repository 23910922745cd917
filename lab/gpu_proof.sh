#!/usr/bin/env bash
# What a GPU's trainings are good for, as JSON in the folder OUT:
#
#     lab/gpu_proof.sh OUT [policy] [student] [drives]      # all three if none is named
#
# policy: one of the real car's size, and its INT8 (OUT/policy/run.json). student: distilled from it. drives: held-out
# error after training on 20 to 320 drives (OUT/drives.jsonl). STEPS of the policy's training: ten minutes by default.
# What is ended goes on where it was when it is run again. Needs `rover` with what [workshop] of pyproject.toml names.
set -euo pipefail
out=$1
shift
mkdir -p "$out"
record() { rover world record "$out/drives-$1" --count "$1" > "$out/drives-$1.log"; }

policy() {
  record 128
  rover train "$out/drives-128" "$out/policy.pth" --size full --steps "${STEPS:-20000}" ${DEVICE:+--device "$DEVICE"}
  [ -f "$out/policy/run.json" ] || rover run "$out/policy.pth" "$out/drives-128" --name policy --runs-dir "$out" --worlds 100
}

student() {
  policy
  [ -f "$out/student/distill.json" ] || rover distill "$out/policy.pth" "$out/drives-128" --name student --runs-dir "$out" \
    --size 320x180 --decoder-layers 2 --feedforward 1600 ${DEVICE:+--device "$DEVICE"}
  [ -f "$out/student/run.json" ] || rover run "$out/student/best_model.pth" "$out/drives-128" --name student --runs-dir "$out" \
    --worlds 100 -p modes '[static]'
}

drives() {
  : > "$out/drives.jsonl"
  for count in 20 40 80 160 320; do
    record "$count"
    rover train "$out/drives-$count" "$out/of-$count.pth" ${DEVICE:+--device "$DEVICE"} > "$out/of-$count.log"
    python3 - "$out/of-$count.pth" "$count" >> "$out/drives.jsonl" << 'END'
import json, sys, torch
made = torch.load(sys.argv[1], map_location="cpu", weights_only=False)
print(json.dumps({"drives": int(sys.argv[2]), "held_out_error": float(made["best_val_loss"])}))
END
  done
}

for part in "${@:-policy student drives}"; do
  for each in $part; do "$each"; done
done
