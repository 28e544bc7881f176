"""Packages of the wheel: `frontend/` is installed as `vio.frontend`.

A checkout has `vio/frontend` as a link to it. Where git makes no links (Windows without developer mode), the folder is
mapped here instead.
"""

from pathlib import Path

from setuptools import find_packages, setup

if Path("vio/frontend").is_dir():
    setup(packages=find_packages(include=["vio", "vio.*"]))
else:
    mapped = [f"vio.{name}" for name in find_packages(include=["frontend", "frontend.*"])]
    setup(packages=[*find_packages(include=["vio", "vio.*"]), *mapped], package_dir={"vio.frontend": "frontend"})
