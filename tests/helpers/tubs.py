"""Donkeycar's tubs, written in its format."""

import json
import math

import cv2
import numpy as np


def angle(i):
    return round(0.8 * math.sin(i / 5), 4)


def throttle(i):
    return round(0.3 * math.cos(i / 7), 4)


def records(count, session="21-08-21_0", first=0, start_ms=1_629_500_000_000):
    return [
        {
            "_index": i, "_session_id": session, "_timestamp_ms": start_ms + 50 * i,
            "cam/image_array": f"{i}_cam_image_array_.jpg", "user/angle": angle(i), "user/mode": "user",
            "user/throttle": throttle(i),
        }
        for i in range(first, first + count)
    ]  # fmt: skip


def tub(root, rows, deleted=(), per_catalog=30, lines=lambda rows: [json.dumps(row) for row in rows]):
    """A tub of donkeycar 4 on."""
    (root / "images").mkdir(parents=True)
    paths = []
    for k, at in enumerate(range(0, len(rows), per_catalog)):
        paths.append(f"catalog_{k}.catalog")
        (root / paths[-1]).write_text("\n".join(lines(rows[at : at + per_catalog])) + "\n")
    for row in rows:
        frame = np.random.default_rng(row["_index"]).integers(0, 255, (6, 8, 3), np.uint8)
        cv2.imwrite(str(root / "images" / row["cam/image_array"]), cv2.resize(frame, (160, 120)))
    last = {"paths": paths, "current_index": len(rows), "max_len": per_catalog, "deleted_indexes": list(deleted)}
    (root / "manifest.json").write_text("\n".join(map(json.dumps, [[], [], {}, {"created_at": 1.0}, last])) + "\n")
    return root
