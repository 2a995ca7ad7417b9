"""Signatures of packs, by OpenSSH: ``FILE.sig`` beside the file, written and read by ``ssh-keygen -Y``."""

from __future__ import annotations

import os
import re
import shutil
import subprocess
from pathlib import Path

from softrig_core import ScenarioError

# Part of each signature, so that one made for mail or git does not count for a pack.
NAMESPACE = "softrig-pack"
SIGNERS = "SOFTRIG_SIGNERS"  # names a file of allowed signers, as in ssh-keygen(1)
_LONG = 60.0  # s


def signature_path(path: Path) -> Path:
    """Return where the signature of a file is."""
    return path.with_name(f"{path.name}.sig")


def sign(path: Path, key: Path) -> Path:
    """Sign a file; the signature is written beside it.

    Raises
    ------
    ScenarioError
        There is no ssh-keygen here, or it refuses the key.
    """
    signature_path(path).unlink(missing_ok=True)
    done = _keygen(["sign", "-f", str(key), "-n", NAMESPACE, str(path)])
    if done.returncode or not signature_path(path).is_file():
        raise ScenarioError(f"--sign {key}: {_last(done.stderr) or 'ssh-keygen wrote no signature'}")
    return signature_path(path)


def signed_by(path: Path) -> str:
    """Return a description of the signer of a file; refuse an invalid signature.

    Raises
    ------
    ScenarioError
        Its signature does not belong to this file, or the signer is not listed in `SIGNERS`.
    """
    signature = signature_path(path)
    if not signature.is_file():
        return "unsigned"
    if shutil.which("ssh-keygen") is None:
        return f"signature {signature.name} not checked, for want of ssh-keygen"
    signers = os.environ.get(SIGNERS) or str(Path("~/.config/softrig/allowed_signers").expanduser())
    # Without a file of signers a signature still proves that the owner of one key has signed these very bytes.
    checked = _keygen(["check-novalidate", "-n", NAMESPACE, "-s", str(signature)], path)
    key = re.search(r"key (SHA256:[A-Za-z0-9+/]+)", checked.stdout + checked.stderr)
    if checked.returncode or key is None:
        raise ScenarioError(f"{signature}: {_last(checked.stderr) or 'no signature'}: it does not sign {path.name}")
    if not os.path.isfile(signers):
        return f"signed by an unknown key, {key[1]}"
    result = _keygen(["find-principals", "-s", str(signature), "-f", signers])
    name = result.stdout.split("\n")[0].strip() if not result.returncode else ""
    if not name:
        raise ScenarioError(f"{signature}: key {key[1]} is not among the signers in {signers}")
    verified = _keygen(["verify", "-f", signers, "-I", name, "-n", NAMESPACE, "-s", str(signature)], path)
    if verified.returncode:
        raise ScenarioError(f"{signature}: {_last(verified.stderr) or 'refused'} (signers: {signers})")
    return f"signed by {name}, {key[1]}"


def _keygen(words: list[str], content: Path | None = None) -> subprocess.CompletedProcess[str]:
    """Call ``ssh-keygen -Y``; it may ask for a passphrase on the terminal."""
    try:
        with open(content if content is not None else os.devnull, "rb") as file:
            return subprocess.run(
                ["ssh-keygen", "-Y", *words], stdin=file, capture_output=True, text=True, timeout=_LONG, check=False
            )
    except FileNotFoundError as error:
        raise ScenarioError(f"{error.filename}: not found; signatures need ssh-keygen (OpenSSH)") from None
    except subprocess.TimeoutExpired:
        raise ScenarioError(f"ssh-keygen gave no answer within {_LONG:g} s") from None


def _last(text: str) -> str:
    return " ".join(text.strip().split("\n")[-1].split())
