from glob import glob

from setuptools import find_packages, setup

NAME = "softrig_bringup"

setup(
    name=NAME,
    version="0.1.0",
    packages=find_packages(),
    package_data={NAME: ["py.typed"]},
    data_files=[
        ("share/ament_index/resource_index/packages", [f"resource/{NAME}"]),
        (f"share/{NAME}", ["package.xml"]),
        (f"share/{NAME}/launch", glob("launch/*.launch.py")),
        (f"share/{NAME}/scenarios", glob("../../config/scenarios/*.yaml")),
    ],
    install_requires=["setuptools"],
    zip_safe=False,
    maintainer="softrig maintainers",
    maintainer_email="softrig@users.noreply.github.com",
    description="Command line, launch files and reports for softrig",
    license="Apache-2.0",
    extras_require={"test": ["pytest"]},
    entry_points={"console_scripts": ["softrig = softrig_bringup.cli:main"]},
)
