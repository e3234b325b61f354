"""Makes and loads a cluster's keys: one TLS certificate for scheduler, workers and runner.

The certificate is self-signed and is the only trusted authority, so only holders of its private key
can connect.
"""

from __future__ import annotations

import os
import stat
from datetime import UTC, datetime, timedelta
from pathlib import Path
from typing import TYPE_CHECKING

from mavfi_cli.core.errors import ConfigError, MavfiError
from mavfi_cli.core.files import writing

if TYPE_CHECKING:
    from distributed.security import Security

CERTIFICATE, KEY = "cert.pem", "key.pem"
_NAME = "mavfi cluster"
_VALID = timedelta(days=3650)
_SKEW = timedelta(days=1)  # clocks of hosts differ


def make_keys(folder: Path) -> None:
    """Write a new certificate and its private key to a folder, creating the folder if necessary.

    Only the user can read the files. Existing files are never replaced.

    Raises:
        ConfigError: one of the files already exists.
        MavfiError: cryptography is not installed.
        RecordError: the files cannot be written.
    """
    try:
        from cryptography import x509
        from cryptography.hazmat.primitives import hashes, serialization
        from cryptography.hazmat.primitives.asymmetric import ec
    except ImportError:
        raise MavfiError("keys need cryptography: pip install 'mavfi[cluster]'") from None
    key = ec.generate_private_key(ec.SECP256R1())
    name = x509.Name([x509.NameAttribute(x509.NameOID.COMMON_NAME, _NAME)])
    now = datetime.now(UTC)
    certificate = (
        x509.CertificateBuilder()
        .subject_name(name)
        .issuer_name(name)
        .public_key(key.public_key())
        .serial_number(x509.random_serial_number())
        .not_valid_before(now - _SKEW)
        .not_valid_after(now + _VALID)
        .add_extension(x509.BasicConstraints(ca=True, path_length=0), critical=True)
        .sign(key, hashes.SHA256())
    )
    pem = serialization.Encoding.PEM
    secret = key.private_bytes(pem, serialization.PrivateFormat.PKCS8, serialization.NoEncryption())
    with writing(folder):
        folder.mkdir(mode=0o700, parents=True, exist_ok=True)
    for file, content in ((KEY, secret), (CERTIFICATE, certificate.public_bytes(pem))):
        _write_new(folder / file, content)


def _write_new(path: Path, content: bytes) -> None:
    try:
        with writing(path):  # O_EXCL also refuses a link
            descriptor = os.open(path, os.O_WRONLY | os.O_CREAT | os.O_EXCL, 0o600)
            with open(descriptor, "wb") as file:
                file.write(content)
    except MavfiError as error:
        if isinstance(error.__context__, FileExistsError):
            raise ConfigError(
                "already exists; choose another folder for the new keys", path=path
            ) from None
        raise


def security(folder: Path) -> Security:
    """Return dask's TLS settings for all roles in a cluster, using the keys in a folder.

    Raises:
        ConfigError: a file is missing, is not a regular file, belongs to another user, or is
            accessible to other users.
    """
    from distributed.security import Security

    certificate, key = (str(_private(folder.absolute() / name)) for name in (CERTIFICATE, KEY))
    own = {
        f"tls_{role}_{kind}": path
        for role in ("client", "scheduler", "worker")
        for kind, path in (("cert", certificate), ("key", key))
    }
    return Security(require_encryption=True, tls_ca_file=certificate, **own)


def _private(path: Path) -> Path:
    try:
        status = path.stat()
    except OSError as error:
        problem = f"{error.strerror}; `mavfi campaign keys DIR` makes the files"
        raise ConfigError(problem, path=path) from None
    if not stat.S_ISREG(status.st_mode) or status.st_uid != os.getuid() or status.st_mode & 0o077:
        raise ConfigError(
            "must be a file that you own and nobody else can access (chmod 600)", path=path
        )
    return path
