"""What setup.cfg cannot say: the configurations of the checkout's conf/ are the package's data, ``avatar/conf``."""

from setuptools import find_packages, setup

setup(packages=[*find_packages(include=["avatar*"]), "avatar.conf"], package_dir={"avatar.conf": "conf"})
