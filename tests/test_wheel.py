"""The wheel is complete: built, unpacked into an empty environment outside the repository, and used there."""

import os
import subprocess
import sys
import venv
from pathlib import Path

ROOT = Path(__file__).parents[1]


def test_the_wheel_runs_outside_the_repository(tmp_path: Path) -> None:
    build = [sys.executable, "-m", "pip", "wheel", "--quiet", "--no-deps", "--no-build-isolation"]
    if subprocess.run([sys.executable, "-m", "pip", "--version"], capture_output=True).returncode:
        build = ["uv", "build", "--quiet", "--wheel", "--no-build-isolation", "--python", sys.executable]
        subprocess.run([*build, "--out-dir", str(tmp_path), str(ROOT)], check=True)
    else:
        subprocess.run([*build, "--wheel-dir", str(tmp_path), str(ROOT)], check=True)
    (wheel,) = tmp_path.glob("optsim-*.whl")

    # An environment without optsim; the pinned dependencies come by path, so that nothing is downloaded.
    venv.create(tmp_path / "venv", with_pip=False)
    python = tmp_path / "venv" / "bin" / "python"
    site = Path(
        subprocess.run(
            [python, "-c", "import site; print(site.getsitepackages()[0])"],
            check=True,
            capture_output=True,
            text=True,
        ).stdout.strip()
    )
    subprocess.run([sys.executable, "-m", "zipfile", "-e", str(wheel), str(site)], check=True)
    dependencies = next(Path(p) for p in sys.path if p.endswith("site-packages"))
    (site / "dependencies.pth").write_text(f"{dependencies}\n")

    program = (
        "import optsim, sys; from optsim.app.cli import main\n"
        f"assert optsim.__file__.startswith({str(site)!r}), optsim.__file__\n"
        "sys.argv = ['optsim', 'run', 'demo', '--dry-run']; main()\n"
    )
    environment = {**os.environ, "OPTSIM_CACHE": str(tmp_path / "cache")}
    environment.pop("PYTHONPATH", None)  # a caller's own optsim would come first
    done = subprocess.run(
        [python, "-c", program], cwd=tmp_path, env=environment, capture_output=True, text=True, timeout=120
    )
    assert done.returncode == 0, done.stderr
    assert "demo: fine" in done.stderr
