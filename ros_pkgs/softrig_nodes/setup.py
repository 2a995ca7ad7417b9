from setuptools import setup

setup()  # all is in setup.cfg; colcon asks for this file
