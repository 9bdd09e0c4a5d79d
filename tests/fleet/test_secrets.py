"""No secret is left in what messages say."""

from __future__ import annotations

import pytest

from gtsam_rwhec.fleet.stores import shown, without_secrets


@pytest.mark.parametrize(
    ("url", "words"),
    [
        ("s3://bucket/robots/a.mcap", "s3://bucket/robots/a.mcap"),
        ("s3://bucket/robots/?.mcap", "s3://bucket/robots/?.mcap"),
        ("https://anna:s3cret@host:9000/a.mcap?X-Amz-Signature=ab12#c", "https://host:9000/a.mcap?..."),
        ("sftp://anna:p%40ss@host/a.mcap", "sftp://host/a.mcap"),
        ("/data/with@sign?/a.mcap", "/data/with@sign?/a.mcap"),
    ],
)
def test_urls_are_shown_without_them(url: str, words: str) -> None:
    assert shown(url) == words


@pytest.mark.parametrize(
    "said",
    [
        "Invalid request: AKIAIOSFODNN7EXAMPLE is not known",
        "GET https://host/a?X-Amz-Credential=abcdefgh&X-Amz-Signature=s1gnature&x=1 failed",
        "connecting to postgres://anna:s1gnature@host",
        "headers={'Authorization': 'Bearer s1gnature', 'Host': 'h'}",
        "secret_access_key = s1gnature",
        '{"aws_session_token": "s1gnature"}',
        "the key is 'quoted/and+more='",
        "the key is quoted%2Fand%2Bmore%3D",
        "user anna, password letmein99",
        "token of the environment: fromenvironment",
    ],
)
def test_words_are_without_them(said: str, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("AWS_SESSION_TOKEN", "fromenvironment")
    monkeypatch.setenv("AWS_SECRET_ACCESS_KEY", "quoted/and+more=")
    clean = without_secrets(said, "https://anna:letmein99@host/a?sig=s1gnature")
    assert "***" in clean or "//host" in clean
    for secret in ("AKIAIOSF", "abcdefgh", "s1gnature", "quoted", "letmein99", "fromenvironment"):
        assert secret not in clean


def test_other_words_stay() -> None:
    said = "s3://bucket/keys/a.mcap: The specified key does not exist. (region: eu-1, token bucket empty)"
    assert without_secrets(said, "s3://bucket/keys/a.mcap") == said
