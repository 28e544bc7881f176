"""Packages of the wheel: `frontend/` is installed as `vio.frontend`.

A checkout has `vio/frontend` as a link to it. Where git makes no links (Windows without developer
mode), the folder is mapped here instead.
"""

from pathlib import Path

from setuptools import find_namespace_packages, setup


def found(name: str) -> list[str]:
    """Packages of a folder, those of YAML files among them."""
    return find_namespace_packages(include=[name, f"{name}.*"], exclude=["*__pycache__*"])


if Path("vio/frontend").is_dir():
    setup(packages=found("vio"))
else:
    mapped = [f"vio.{name}" for name in found("frontend")]
    setup(packages=[*found("vio"), *mapped], package_dir={"vio.frontend": "frontend"})
