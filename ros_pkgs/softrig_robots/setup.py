from pathlib import Path

from setuptools import find_packages, setup

NAME = "softrig_robots"

setup(
    name=NAME,
    version="0.1.0",
    packages=find_packages(),
    package_data={NAME: ["py.typed", "urdf/*.urdf"]},
    data_files=[
        ("share/ament_index/resource_index/packages", [f"resource/{NAME}"]),
        (f"share/{NAME}", ["package.xml"]),
        (f"share/{NAME}/urdf", sorted(map(str, Path(NAME, "urdf").glob("*.urdf")))),
    ],
    install_requires=["setuptools"],
    zip_safe=False,
    maintainer="softrig maintainers",
    maintainer_email="softrig@users.noreply.github.com",
    description="Voltage-driven robots as rclpy nodes: rigid-body dynamics, 3-link manipulator, rehabilitation robot",
    license="Apache-2.0",
    extras_require={"test": ["pytest"]},
    entry_points={
        "console_scripts": [
            "manipulator_plant = softrig_robots.manipulator.plant:main",
            "robot_dynamics = softrig_robots.dynamics:main",
            "tracking_metrics = softrig_robots.tracking:main",
            "trajectory_source = softrig_robots.manipulator.trajectory:main",
            "rehab_plant = softrig_robots.rehab.plant:main",
            "prom_reference = softrig_robots.rehab.prom:main",
            "patient = softrig_robots.rehab.patient:main",
            "impedance = softrig_robots.rehab.impedance:main",
            "rehab_metrics = softrig_robots.rehab.metrics:main",
            "tuner = softrig_robots.rehab.tuner:main",
            "voltage_controller = softrig_robots.rehab.controller:main",
            "vcs_controller = softrig_robots.manipulator.controller:main",
        ]
    },
)
