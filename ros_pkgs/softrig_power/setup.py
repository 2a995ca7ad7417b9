from setuptools import find_packages, setup

NAME = "softrig_power"

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
    description="Power converters and power systems as rclpy nodes: photovoltaic array",
    license="Apache-2.0",
    extras_require={"test": ["pytest"]},
    entry_points={
        "console_scripts": [
            "mppt_metrics = softrig_power.pv.metrics:main",
            "mppt_optimizer = softrig_power.pv.mppt:main",
            "mppt_statistics = softrig_power.pv.statistics:main",
            "pv_curves = softrig_power.pv.curves:main",
            "pv_plant = softrig_power.pv.plant:main",
            "shading_source = softrig_power.pv.shading:main",
        ]
    },
)
