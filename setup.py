"""Entry point that colcon needs; everything is declared in pyproject.toml and setup.cfg."""

from setuptools import setup

setup()
