"""The wheel takes the default settings, `configs/`, into the package `experiments`."""

import pathlib
import shutil

from setuptools import setup
from setuptools.command.build_py import build_py


class WithSettings(build_py):
    """Copies configs/ to experiments/configs in a wheel. An editable install is a checkout."""

    def run(self) -> None:
        super().run()
        if not self.editable_mode:
            target = pathlib.Path(self.build_lib) / "experiments" / "configs"
            shutil.copytree("configs", target, dirs_exist_ok=True)


setup(cmdclass={"build_py": WithSettings})
