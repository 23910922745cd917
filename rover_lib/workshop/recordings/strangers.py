"""Recognise what owners of other cars and robots bring in place of our recordings, so that it is called what it is."""

from pathlib import Path

from rover_lib.onboard.kinds import EPISODE_FILES, kinds_of

READ = "only folders of episodes, LeRobotDatasets and donkeycar tubs are read: write a LeRobotDataset of it"
# What lies in a folder, and what the folder then is.
OTHERS = {
    "model_metadata.json": "an AWS DeepRacer model",
    "policy_best.ckpt": "a checkpoint of the first ACT",
    "dataset_stats.pkl": "a checkpoint of the first ACT",
    "[0-9]*_[0-9]*_*.jpg": "pictures of a JetRacer or JetBot with a point to drive to in their names, without actions",
    "*.hdf5": "recordings of the first ACT or of robomimic, in HDF5 files",
    "*.h5": "recordings in HDF5 files",
    "driving_log.csv": "recordings of Udacity's simulator",
    "*.zarr": "recordings of a diffusion policy, in zarr",
    ".zgroup": "recordings of a diffusion policy, in zarr",
    "*.tfrecord*": "recordings in TensorFlow's records",
    "*.bag": "a ROS bag",
    "*.db3": "a ROS bag",
    "*.mcap": "a log in MCAP",
    "*.arrow": "a table of Hugging Face's, without meta/info.json",
    "*.parquet": "a table of a LeRobotDataset, or of others, without meta/info.json",
    "*.zip": "recordings that are packed",
    "*.tar*": "recordings that are packed",
    "*.mp4": "videos without actions",
}


def name_stranger(root: Path) -> tuple[str, str] | None:
    """Return what a folder holds in place of our episodes, and what to do; None if it may hold episodes."""
    inside = [p for p in sorted(root.iterdir()) if p.is_dir() and not p.name.startswith(".")]
    if any((folder / name).exists() for folder in (root, *inside) for name in EPISODE_FILES):
        return None
    for kind, words, remedy in (
        ("tub", "donkeycar tubs", "rover export-dataset {} OUT, and so for each"),
        ("dataset", "LeRobotDatasets", "give one of them, such as {}"),
        ("recordings", "folders of recordings", "give one of them, such as {}"),
    ):
        if found := [folder for folder in inside if kind in kinds_of(folder)]:
            return f"a folder of {len(found)} {words}", remedy.format(found[0])
    for pattern, words in OTHERS.items():
        if next(root.glob(pattern), None) or (inside and next(inside[0].glob(pattern), None)):
            return words, READ
    return None
