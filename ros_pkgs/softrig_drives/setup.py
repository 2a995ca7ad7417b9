from setuptools import find_packages, setup

NAME = "softrig_drives"

setup(
    name=NAME,
    version="0.1.0",
    packages=find_packages(),
    package_data={NAME: ["py.typed"]},
    data_files=[
        ("share/ament_index/resource_index/packages", [f"resource/{NAME}"]),
        (f"share/{NAME}", ["package.xml"]),
    ],
    install_requires=["setuptools"],
    zip_safe=False,
    maintainer="softrig maintainers",
    maintainer_email="softrig@users.noreply.github.com",
    description="Electric drives as rclpy nodes: DC motor, induction motor",
    license="Apache-2.0",
    extras_require={"test": ["pytest"]},
    entry_points={
        "console_scripts": [
            "axis_metrics = softrig_drives.dc_axis.metrics:main",
            "dc_axis_plant = softrig_drives.dc_axis.plant:main",
            "dc_motor_metrics = softrig_drives.dc_motor.metrics:main",
            "dc_motor_pid = softrig_drives.dc_motor.pid:main",
            "dc_motor_plant = softrig_drives.dc_motor.plant:main",
            "dc_motor_smc = softrig_drives.dc_motor.sliding_mode:main",
            "dc_motor_smc_kalman = softrig_drives.dc_motor.kalman_surface:main",
            "fsfb_controller = softrig_drives.dc_axis.controller:main",
            "dtc_controller = softrig_drives.induction_dtc.dtc:main",
            "flux_monitor = softrig_drives.induction_dtc.monitor:main",
            "im_plant = softrig_drives.induction_dtc.plant:main",
            "speed_controller = softrig_drives.induction_dtc.speed:main",
            "step_buttons = softrig_drives.dc_axis.buttons:main",
        ]
    },
)
