"""Credentials of a profile, as Amazon's own tools find them."""

from pathlib import Path

import pytest
from storage_server import READ_ONLY

from tcpipe.errors import StoreError
from tcpipe.formats.object_storage import read_aws_profile
from tcpipe.formats.place import open_place

CREDENTIALS = """
[default]
aws_access_key_id = A
aws_secret_access_key = B
[lab]
aws_access_key_id = C
aws_secret_access_key = D
aws_session_token = E
"""
CONFIG = """
[default]
region = eu-central-1
[profile lab]
region = eu-north-1
endpoint_url = https://objects.example.org
s3 =
    addressing_style = path
[profile sso]
sso_start_url = https://example.org
"""
DEFAULT = {"access_key_id": "A", "secret_access_key": "B", "region": "eu-central-1"}
LAB = {
    "access_key_id": "C", "secret_access_key": "D", "session_token": "E", "region": "eu-north-1",
    "endpoint": "https://objects.example.org",
}  # fmt: skip


@pytest.fixture
def home(tmp_path: Path) -> dict[str, str]:
    (tmp_path / ".aws").mkdir()
    for name, text in (("credentials", CREDENTIALS), ("config", CONFIG)):
        (tmp_path / ".aws" / name).write_text(text)
    return {"HOME": str(tmp_path)}


def test_a_profile_gives_what_the_environment_does_not(home: dict[str, str], tmp_path: Path) -> None:
    assert read_aws_profile(home) == DEFAULT
    assert read_aws_profile(home | {"AWS_PROFILE": "lab"}) == LAB
    keys = {"AWS_ACCESS_KEY_ID": "F", "AWS_PROFILE": "lab", "AWS_ENDPOINT_URL": "http://other"}
    assert read_aws_profile(home | keys) == {"region": "eu-north-1"}
    assert read_aws_profile(home | {"AWS_SKIP_SIGNATURE": "true", "AWS_REGION": "x"}) == {}
    assert read_aws_profile({"HOME": str(tmp_path / "nobody")}) == {}
    elsewhere = {"HOME": "/nowhere", "AWS_SHARED_CREDENTIALS_FILE": str(tmp_path / ".aws" / "credentials")}
    assert read_aws_profile(elsewhere | {"AWS_PROFILE": "lab"}).keys() == LAB.keys() - {"region", "endpoint"}


@pytest.mark.usefixtures("served")
def test_a_profile_that_cannot_be_used_is_one_line(
    home: dict[str, str], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    with pytest.raises(ValueError, match=r"have no profile other, which AWS_PROFILE names"):
        read_aws_profile(home | {"AWS_PROFILE": "other"})
    (tmp_path / "served" / READ_ONLY).mkdir()
    monkeypatch.setenv("HOME", home["HOME"])
    monkeypatch.delenv("AWS_SKIP_SIGNATURE")
    open_place(f"s3://{READ_ONLY}").check()
    monkeypatch.setenv("AWS_PROFILE", "sso")
    exported = r'the profile sso contains no keys; run: eval "\$\(aws configure export-credentials --profile sso --format env\)"'
    with pytest.raises(StoreError, match=exported):
        open_place(f"s3://{READ_ONLY}").check()
    (tmp_path / ".aws" / "config").write_text("region = x")
    with pytest.raises(ValueError, match=r"config: cannot be read as an AWS configuration"):
        read_aws_profile(home)
