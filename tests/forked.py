"""``train.py`` in a child of this process, which has imported everything: for what a run leaves in its process."""

from __future__ import annotations

import os
import runpy
import subprocess
import sys
import tempfile
import traceback
from pathlib import Path

ROOT = Path(__file__).parents[1]


def train(argv: list[str], packages: list[Path], cwd: Path = ROOT) -> subprocess.CompletedProcess[str]:
    """The command's exit code and output.

    :param packages: folders in which ``--gym-packages`` are found
    """
    with tempfile.TemporaryFile() as out, tempfile.TemporaryFile() as err:
        child = os.fork()
        if child == 0:
            code = 1
            try:
                os.dup2(out.fileno(), 1)
                os.dup2(err.fileno(), 2)
                sys.stdout, sys.stderr = (open(number, "w", closefd=False) for number in (1, 2))
                os.chdir(cwd)
                sys.path[:0] = map(str, packages)
                for name in {path.stem for folder in packages for path in folder.glob("*.py")} & sys.modules.keys():
                    del sys.modules[name]  # it registers again what the test that imported it has taken back
                sys.argv = [str(ROOT / "train.py"), *argv]
                runpy.run_path(sys.argv[0], run_name="__main__")
            except SystemExit as exit:
                code = exit.code if isinstance(exit.code, int) else 1
            except BaseException:
                traceback.print_exc()
            finally:
                sys.stdout.flush()
                sys.stderr.flush()
                os._exit(code)
        code = os.waitstatus_to_exitcode(os.waitpid(child, 0)[1])
        texts = []
        for file in (out, err):
            file.seek(0)
            texts.append(file.read().decode())
    return subprocess.CompletedProcess(argv, code, *texts)
