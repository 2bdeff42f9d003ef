"""Credentials, region and endpoint of an AWS profile: ``~/.aws/credentials`` and ``~/.aws/config``, as Amazon's own tools read them."""

from __future__ import annotations

import configparser
import os
from collections.abc import Mapping
from pathlib import Path

_KEYS = {
    "aws_access_key_id": "access_key_id",
    "aws_secret_access_key": "secret_access_key",
    "aws_session_token": "session_token",
}
ENDPOINT_VARIABLES = ("AWS_ENDPOINT_URL", "AWS_ENDPOINT_URL_S3", "AWS_ENDPOINT")
_LOCATIONS = {
    "region": ("region", ("AWS_REGION", "AWS_DEFAULT_REGION")),
    "endpoint_url": ("endpoint", ENDPOINT_VARIABLES),
}
"""By entry of a profile: obstore's name for it, and the environment variables that take precedence."""
_OTHER_CREDENTIALS = (
    *("AWS_ACCESS_KEY_ID", "AWS_SKIP_SIGNATURE", "AWS_WEB_IDENTITY_TOKEN_FILE"),
    *("AWS_CONTAINER_CREDENTIALS_RELATIVE_URI", "AWS_CONTAINER_CREDENTIALS_FULL_URI"),
)
"""Environment variables that take precedence over the keys of a profile."""


def read_aws_profile(environment: Mapping[str, str] = os.environ) -> dict[str, str]:
    """Return the settings of the profile ``AWS_PROFILE``, else ``default``, that the environment does not give, by obstore's names."""
    wanted = environment.get("AWS_PROFILE")
    name, home = wanted or "default", Path(environment.get("HOME", "~")).expanduser() / ".aws"
    credentials = Path(environment.get("AWS_SHARED_CREDENTIALS_FILE", home / "credentials")).expanduser()
    config = Path(environment.get("AWS_CONFIG_FILE", home / "config")).expanduser()
    sections = (
        _read_section(config, name if name == "default" else f"profile {name}"),
        _read_section(credentials, name),
    )
    if wanted and sections == (None, None):
        raise ValueError(f"{credentials} and {config} have no profile {name}, which AWS_PROFILE names")
    found = {**(sections[0] or {}), **(sections[1] or {})}
    said = {
        key: found[entry]
        for entry, (key, given) in _LOCATIONS.items()
        if entry in found and not environment.keys() & given
    }
    if environment.keys() & _OTHER_CREDENTIALS:
        return said
    keys = {key: found[entry] for entry, key in _KEYS.items() if entry in found}
    if wanted and not {"access_key_id", "secret_access_key"} <= keys.keys():
        export = f'eval "$(aws configure export-credentials --profile {name} --format env)"'
        raise ValueError(f"the profile {name} holds no keys; run: {export}")
    return said | keys


def _read_section(path: Path, name: str) -> Mapping[str, str] | None:
    parser = configparser.RawConfigParser(default_section="")
    try:
        parser.read(path, encoding="utf-8")
    except (configparser.Error, UnicodeDecodeError) as error:
        raise ValueError(f"{path}: cannot be read as an AWS configuration ({type(error).__name__})") from None
    return dict(parser[name]) if parser.has_section(name) else None
