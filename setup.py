"""Package adp_path_follower for pip and for colcon (ament_python)."""

import re
from glob import glob
from pathlib import Path as FilePath

from setuptools import find_packages, setup

NAME = "adp_path_follower"
VERSION = re.search(r'__version__ = "(.+)"', FilePath(NAME, "__init__.py").read_text()).group(1)

README = FilePath("README.md")  # colcon build --symlink-install does not link it

JAZZY_WHEELS = [
    "ros-jazzy-rclpy",
    "ros-jazzy-rmw-fastrtps-cpp",
    "ros-jazzy-nav-msgs",
    "ros-jazzy-geometry-msgs",
    "ros-jazzy-visualization-msgs",
    "ros-jazzy-std-srvs",
    "ros-jazzy-diagnostic-msgs",
]

setup(
    name=NAME,
    version=VERSION,
    description="Path following for unicycle robots by online approximate optimal control",
    long_description=README.read_text(encoding="utf-8") if README.is_file() else "",
    long_description_content_type="text/markdown",
    license="Apache-2.0",
    maintainer="adp_path_follower maintainers",
    maintainer_email="maintainers@adp-path-follower.example.org",
    packages=find_packages(include=[NAME, f"{NAME}.*", "sim_unicycle"]),
    package_data={
        NAME: ["py.typed", "data/*.json", "data/*.csv", "drawing/templates/*"],
        "sim_unicycle": ["py.typed"],
    },
    data_files=[
        ("share/ament_index/resource_index/packages", [f"resource/{NAME}"]),
        (f"share/{NAME}", ["package.xml"]),
        (f"share/{NAME}/config", glob("config/*.yaml")),
        (f"share/{NAME}/config/faults", glob("config/faults/*.yaml")),
        (f"share/{NAME}/config/layouts", glob("config/layouts/*")),
        (f"share/{NAME}/config/robots", glob("config/robots/*.yaml")),
        (f"share/{NAME}/config/sweeps", glob("config/sweeps/*.yaml")),
        (f"share/{NAME}/docs", glob("docs/*.md")),
        (f"share/{NAME}/launch", glob("launch/*.launch.py")),
    ],
    python_requires=">=3.11,<3.13",
    install_requires=[
        "numpy>=1.26",
        "scipy>=1.11",
        "rosbags>=0.11.6,<0.12",
        "mcap>=1.5,<2",
        "PyYAML>=6.0",
        "click>=8.1",
        "matplotlib>=3.6",
    ],
    extras_require={
        "jazzy": JAZZY_WHEELS,
        "optimum": ["casadi>=3.6"],
        "report": ["plotly>=6.0,<8", "jinja2>=3.1"],
        "sweep": [
            "distributed>=2025.1,<2027",
            "optuna>=5.0,<6",
            "pyarrow>=15.0",
            "plotly>=6.0,<8",
            "jinja2>=3.1",
        ],
        "tools": ["evo>=1.28", "pandas>=2.0"],  # that the docs use beside the package
        "docs": ["mkdocs-material>=9.5,<10", "mkdocstrings[python]>=0.27,<2"],
        "test": [
            "pytest>=7.4",
            "pytest-xdist>=3.8",
            "hypothesis>=6.90",
            "evo>=1.28",
            "mcap-ros2-support>=0.5",
            "playwright>=1.40",
            "ipykernel>=6.29",
            "nbclient>=0.10",
        ],
        "robots": ["mujoco>=3.2,<5"],  # for bench/robots
        "lint": ["ruff==0.17.6", "mypy==2.4.1", "types-PyYAML"],
    },
    entry_points={
        "console_scripts": [
            "controller = adp_path_follower.ros.runtime.entry:controller",
            "path_publisher = adp_path_follower.ros.runtime.entry:path_publisher",
            "recorder = adp_path_follower.ros.runtime.entry:recorder",
            "sim_unicycle = adp_path_follower.ros.runtime.entry:sim_unicycle",
            "adp = adp_path_follower.cli.main:main",
        ],
    },
)
