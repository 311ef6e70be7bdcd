"""Choosing a backend: nothing is imported early, nothing aborts, and errors carry the cure."""

import os
import subprocess
import sys

import pytest

from optsim.core.errors import BackendError, ConfigError
from optsim.render import backend, choose_backend


def test_importing_render_and_scene_imports_no_renderer():
    code = (
        "import sys, optsim.render, optsim.scene, optsim.app.doctor; "
        "sys.exit('mitsuba' in sys.modules or 'drjit' in sys.modules)"
    )
    assert subprocess.run([sys.executable, "-c", code], check=False).returncode == 0


def test_a_backend_is_found_and_remembered(monkeypatch):
    choose_backend.cache_clear()  # what another test chose may be remembered in another folder
    report = choose_backend()
    assert report.variant in backend.VARIANTS
    assert report.attempts[-1].works
    choose_backend.cache_clear()
    # The second time no subprocess may be needed: the probe's result is on disk.
    monkeypatch.setattr(backend, "probe", lambda *_: pytest.fail("probed again"))
    assert choose_backend() == report


def test_an_unknown_backend_is_named():
    with pytest.raises(ConfigError, match="did you mean 'llvm_ad_mono'"):
        choose_backend("llvm_mono")


def test_a_backend_that_dies_is_an_error_with_its_cure(monkeypatch):
    died = backend.Attempt("llvm_ad_mono", "", False, "killed by signal 6: LLVM ERROR")
    monkeypatch.setattr(backend, "_remembered_probe", lambda variant, library: died)
    choose_backend.cache_clear()
    with pytest.raises(BackendError, match=r"(?s)signal 6.*cure: install karellen-llvm-core"):
        choose_backend("llvm_ad_mono")
    choose_backend.cache_clear()


def test_a_bad_library_is_caught_in_the_subprocess(tmp_path):
    library = tmp_path / "libLLVM.so.19"
    library.write_bytes(b"no library")
    attempt = backend.probe("llvm_ad_mono", str(library))
    assert not attempt.works
    assert attempt.message


@pytest.mark.parametrize("chosen", ["", "/opt/good/libLLVM.so.20"])
def test_a_library_that_failed_its_probe_is_not_used_after_all(chosen):
    """The one in the environment failed; Dr.Jit's own search (""), or another library, did not."""
    code = f"""
import os, sys
from types import SimpleNamespace
from optsim.render import backend
sys.modules["mitsuba"] = SimpleNamespace(variant=lambda: "llvm_ad_mono")
backend.choose_backend = lambda _: backend.BackendReport("llvm_ad_mono", {chosen!r}, False, "", ())
backend.activate()
print(os.environ.get("DRJIT_LIBLLVM_PATH", ""))
"""
    environment = os.environ | {"DRJIT_LIBLLVM_PATH": "/opt/broken/libLLVM.so.23"}
    done = subprocess.run(
        [sys.executable, "-c", code], env=environment, capture_output=True, text=True, check=True
    )
    assert done.stdout.strip() == chosen


@pytest.mark.parametrize(
    ("name", "major"),
    [("libLLVM.so.23.1", 23), ("libLLVM-15.so", 15), ("libLLVM-15.so.1", 15), ("libLLVM.so", 0)],
)
def test_the_version_is_read_off_the_name(name, major, tmp_path):
    assert backend.llvm_major(str(tmp_path / name)) == major


def test_an_inherited_old_library_is_not_accepted(monkeypatch, tmp_path):
    monkeypatch.setenv("DRJIT_LIBLLVM_PATH", str(tmp_path / "libLLVM-15.so"))
    assert str(tmp_path / "libLLVM-15.so") not in list(backend.llvm_libraries())
    monkeypatch.setenv("DRJIT_LIBLLVM_PATH", str(tmp_path / "libLLVM-17.so"))
    assert next(backend.llvm_libraries()) == str(tmp_path / "libLLVM-17.so")


def test_scalar_is_the_last_resort_and_says_so(monkeypatch):
    def attempt(variant, library):
        return backend.Attempt(variant, library, variant == "scalar_rgb", "no LLVM")

    monkeypatch.setattr(backend, "_remembered_probe", attempt)
    choose_backend.cache_clear()
    report = choose_backend()
    choose_backend.cache_clear()
    assert (report.variant, report.preview) == ("scalar_rgb", True)
    assert "preview" in report.reason
    assert "cure" in report.reason
