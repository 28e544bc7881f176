"""Names of what lies in a run's folder: writers, readers and the check of what may be replaced
take them from here.
"""


class RunFile:
    """Files of a run's folder."""

    # a folder with this file, and with nothing but `FILES`, is a run's and may be replaced
    METRICS = "metrics.json"
    CONFIG = "config.yaml"
    TRAJECTORY = "trajectory.tum"
    TRAJECTORY_KITTI = "trajectory.kitti"
    ESTIMATES = "estimates.npy"
    FRAMES = "frames.csv"
    LANDMARKS = "landmarks.ply"
    REFERENCE = "reference.tum"
    DEAD_RECKONING = "dead_reckoning.tum"
    OBSERVATIONS = "observations.npz"
    PICTURE = "trajectory.png"
    CALIBRATION = "camchain-imucam.yaml"  # the corrected one, where no other file is named for it
    MAP_TRAJECTORY = "map_trajectory.tum"
    MAP_CAUSAL = "map_causal.tum"
    MAP_COVARIANCE = "map_covariance.npy"
    MAP_KEYFRAMES = "map_keyframes.csv"
    MAP_KEYFRAMES_COVARIANCE = "map_keyframes_covariance.npy"
    LOOPS = "loops.csv"
    LOOP_MATCHES = "loop_matches.npz"
    FEATURES = "features.jpg"  # one image with its features
    REPORT = "report.html"  # of `vio report`
    UNFINISHED = "unfinished"  # folder, while the run goes on or can go on


class MeshFile:
    """What `vio mesh` writes: a folder in the run's folder, and its files."""

    FOLDER = "mesh"
    FACTS = "mesh.json"
    MESH = "mesh.ply"
    POINTS = "points.ply"
    GLTF = "mesh.glb"  # y is up
    PICTURE = "preview.png"
    OCCUPANCY = "occupancy"  # .pgm and .yaml


FILES = tuple(value for name, value in vars(RunFile).items() if name.isupper())
# trajectories that are a run's estimates, unlike its reference
ESTIMATED = (
    RunFile.TRAJECTORY,
    RunFile.TRAJECTORY_KITTI,
    RunFile.DEAD_RECKONING,
    RunFile.MAP_TRAJECTORY,
    RunFile.MAP_CAUSAL,
)
CHECKPOINT = "checkpoint"  # in UNFINISHED, as are the tables
REQUEST = "run.json"  # likewise: what the run was asked to do
