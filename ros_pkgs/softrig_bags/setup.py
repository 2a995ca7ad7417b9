from setuptools import find_packages, setup

NAME = "softrig_bags"

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
    description="Bags: record, replay in lockstep, read, compare, repair",
    license="Apache-2.0",
    extras_require={"test": ["pytest"]},
    entry_points={
        "console_scripts": [
            "recorder = softrig_bags.cli:main_record",
            "player = softrig_bags.cli:main_play",
        ]
    },
)
