"""What lies in a recording's folder and is not used."""

from __future__ import annotations

import fnmatch
import re
from collections import Counter
from collections.abc import Sequence
from pathlib import Path

from vio.dataclass import dataclass
from vio.datasets.images import SUFFIXES

# no data
_SILENT = (
    "readme*",
    "license*",
    "*.md",
    "simulation.json",
    "rectification.json",
    "conversion.json",
)
_PHOTOMETRIC = ("pcalib*.txt", "vignette*.png")  # of DSO and TUM-VI
_NAMED = 12  # of a list
_CAMERA_FILE = re.compile(r"^\s*cam\d_calib\s*:\s*[\"']?(?:[^\"'\n]*/)?([\w.-]+)", re.MULTILINE)


@dataclass(frozen=True, slots=True)
class Layout:
    """Where the parts of a recording lie."""

    root: Path  # the folder that was given
    base: Path  # holds the image folders: the root, or its mav0
    left: Path  # folder of the images, or video
    right: Path

    def above(self, side: Path) -> tuple[Path, ...]:
        """Return the folders between that of a camera's images and the root, from below."""
        return tuple(folder for folder in side.parents if self.root in folder.parents)


def unused_note(layout: Layout, used: Sequence[Path]) -> list[str]:
    """Return a note that names what lies in the folder and was not read, and one for photometric
    files.

    Files in `used` need not exist.
    """
    found = _not_read(layout, _kept(layout, [file for file in used if file.exists()]))
    photometric = [name for name in found if _fits(Path(name).name, _PHOTOMETRIC)]
    others = [name for name in found if name not in photometric]
    notes = []
    if photometric:
        why = "photometric calibration is not applied, as the tracks gain nothing by it"
        notes.append(f"{why}: {listed(photometric)}")
    if others:
        return [*notes, f"not used: {listed(others)}"]
    return notes


def _kept(layout: Layout, used: Sequence[Path]) -> set[Path]:
    """Return all files and folders that were read, with the folders that hold them."""
    kept = {layout.left.absolute(), layout.right.absolute(), *(file.absolute() for file in used)}
    kept |= {parent for path in kept for parent in path.parents}
    for path in used:  # the other files of a calibration that lies in several
        if path.suffix.lower() in (".yaml", ".yml", ".txt", ".xml"):
            kept |= {other.absolute() for other in path.parent.iterdir() if _belongs(other, path)}
            kept |= {path.with_name(name).absolute() for name in _files_named_in(path)}
    return kept


def _files_named_in(path: Path) -> list[str]:
    """Return the files of cameras that settings name, as `cam0_calib: "left.yaml"`."""
    try:
        return _CAMERA_FILE.findall(path.read_text(encoding="utf-8", errors="ignore"))
    except OSError:
        return []


def _not_read(layout: Layout, kept: set[Path]) -> list[str]:
    """Return the names of what else lies in the folders of a recording."""
    images = [side for side in (layout.left, layout.right) if side.is_dir()]
    within = (layout.base, *images, *(folder for side in images for folder in layout.above(side)))
    folders = [layout.root, *(f for f in within if layout.root in f.parents)]
    found = []
    for folder in dict.fromkeys(folders):
        for child in sorted(folder.iterdir()):
            expected = child.absolute() in kept or _is_silent(child, with_images=folder in images)
            if not expected:
                found.append(_name_in(layout.root, child))
    return found


def _name_in(root: Path, child: Path) -> str:
    """Return the path of a file, or of a folder with a slash behind, within a recording."""
    return f"{child.relative_to(root)}{'/' if child.is_dir() else ''}"


def _is_silent(child: Path, *, with_images: bool) -> bool:
    """Tell whether nothing is said of a file: a hidden or a usual one, or an image among images."""
    if with_images and child.suffix.lower() in SUFFIXES:
        return True
    return child.name.startswith(".") or _fits(child.name.lower(), _SILENT)


def _fits(name: str, patterns: Sequence[str]) -> bool:
    return any(fnmatch.fnmatch(name, pattern) for pattern in patterns)


def listed(names: Sequence[str]) -> str:
    """Return the first names, and how many more there are."""
    shown = ", ".join(names[:_NAMED]) or "none"
    if len(names) > _NAMED:
        return f"{shown} and {len(names) - _NAMED} more"
    return shown


def _belongs(other: Path, calibration: Path) -> bool:
    """Return whether a file is read together with a calibration file."""
    partners = {"left": "right", "intrinsic": "extrinsic", "camchain": "imu", "calibration": "imu"}
    named = any(a in calibration.name and b in other.name for a, b in partners.items())
    other_chain = "cam" in other.name and "chain" in other.name  # a calibration by itself
    return (named and not other_chain and other.suffix in (".yaml", ".yml")) or (
        calibration.name.startswith("calib_cam_to_cam")
        and (other.name in ("calib_velo_to_cam.txt", "calib_imu_to_velo.txt"))
    )


ARCHIVES = (".zip", ".tar", ".gz", ".tgz", ".7z", ".rar", ".xz", ".bz2", ".zst", ".zstd")
_OTHER_IMAGES = (".jp2", ".j2k", ".gif", ".heic", ".avif", ".jxl", ".exr", ".dng", ".raw", ".npy")


# recordings of other programs: what they are, and what to do
_STREAM = (
    "a stream of images without times",
    "pack it with its frame rate (ffmpeg -framerate RATE -i FILE -c copy left.mp4)",
)
_SURROUND = ("a video of several lenses", "export one mp4 a lens, left.mp4 and right.mp4")
_FOREIGN: dict[str, tuple[str, str]] = {
    **dict.fromkeys((".h264", ".264", ".h265", ".265", ".hevc", ".mjpeg", ".mjpg"), _STREAM),
    **dict.fromkeys((".insv", ".360", ".lrv"), _SURROUND),
    **dict.fromkeys(
        (".svo", ".svo2"),
        ("a recording of ZED's SDK", "export its left and right images with that SDK"),
    ),
    ".map": ("a map of vio run", "give the recording; vio map show says what the map holds"),
    ".vrs": ("a VRS file", "extract its images and its IMU (vrs extract-all)"),
    ".ulg": ("a log of PX4", "write its IMU as a table (ulog2csv), named imu.csv"),
    ".db": ("a database, as of RTAB-Map", "export its images and calibration with that program"),
    **dict.fromkeys(
        (".h5", ".hdf5"), ("an HDF5 file", "write its images as files and its IMU as imu.csv")
    ),
}


def foreign_file(path: Path) -> str | None:
    """Say what a file of another program is, and what to do with it; None: it is not known."""
    found = _FOREIGN.get(path.suffix.lower())
    if found is None or path.name.startswith(".") or path.name.lower() == "thumbs.db":
        return None
    what, remedy = found
    return f"{path}: is {what}, which is not read; {remedy}"


def unread_files(path: Path) -> str | None:
    """Say what to do with archives, or with images of another form, which a path is or a folder and
    the folders in it hold; None: there are none.
    """
    if path.is_file():
        files = [path]
    else:
        files = [*path.glob("*.*"), *path.glob("*/*.*")]
    archive = next((file for file in files if file.suffix.lower() in ARCHIVES), None)
    if archive is not None:
        inside = Path(archive.stem).suffix.lower() in (".db3", ".mcap", ".bag")
        folder = (
            "; of a ROS 2 bag, its folder with metadata.yaml is read as it is" if inside else ""
        )
        return f"{archive}: is an archive; unpack it, and give what it holds{folder}"
    foreign = next(filter(None, map(foreign_file, sorted(files))), None)
    if foreign is not None:
        return foreign
    counts = Counter(file.suffix.lower() for file in files)
    suffix = max(_OTHER_IMAGES, key=lambda suffix: counts[suffix])
    if not counts[suffix]:
        return None
    return (
        f"{path}: holds {counts[suffix]} files {suffix}, which are not read; write the images as PNG, "
        "JPEG, BMP, TIFF, PGM, PPM or WebP"
    )
