from __future__ import annotations

import pytest
from hypothesis import given
from hypothesis import strategies as st

from mavfi_cli.core.errors import LinkError
from mavfi_cli.link.endpoint import parse_endpoint
from mavfi_cli.link.transport import open_listener, open_transport


@pytest.mark.parametrize(
    ("url", "scheme", "host", "port"),
    [
        ("udpin:127.0.0.1:14540", "udpin", "127.0.0.1", 14540),
        ("udpin:14540", "udpin", "127.0.0.1", 14540),
        ("udpin::14540", "udpin", "127.0.0.1", 14540),
        ("udp://:14540", "udpin", "127.0.0.1", 14540),
        ("udpin://0.0.0.0:14540", "udpin", "0.0.0.0", 14540),
        ("udpout://localhost:14580", "udpout", "localhost", 14580),
        ("tcp:10.0.0.7:5760", "tcp", "10.0.0.7", 5760),
        ("tcpout://10.0.0.7:5760", "tcp", "10.0.0.7", 5760),
        ("tcpin:[::1]:5760", "tcpin", "::1", 5760),
    ],
)
def test_network_urls(url: str, scheme: str, host: str, port: int) -> None:
    endpoint = parse_endpoint(url)
    assert (endpoint.scheme, endpoint.host, endpoint.port) == (scheme, host, port)


@pytest.mark.parametrize(
    ("url", "device", "baud"),
    [
        ("serial:/dev/ttyACM0:921600", "/dev/ttyACM0", 921600),
        ("serial:/dev/ttyACM0", "/dev/ttyACM0", 57600),
        ("serial:///dev/ttyACM0:921600", "/dev/ttyACM0", 921600),
        (
            "serial:/dev/serial/by-path/pci-0000:00:14.0-usb:57600",
            "/dev/serial/by-path/pci-0000:00:14.0-usb",
            57600,
        ),
    ],
)
def test_serial_urls(url: str, device: str, baud: int) -> None:
    endpoint = parse_endpoint(url)
    assert (endpoint.scheme, endpoint.device, endpoint.baud) == ("serial", device, baud)


@pytest.mark.parametrize(
    ("url", "problem"),
    [
        ("", "unknown kind of endpoint"),
        ("14540", "unknown kind of endpoint"),
        ("htpp:127.0.0.1:80", "udpin:.*udpout:.*tcp:.*tcpin:.*serial:.*fd:"),
        ("udpout:14540", "form udpout:host:port"),
        ("udpout::14540", "form udpout:host:port"),
        ("tcp:host:port", "not of the form"),
        ("tcp:host:70000", "at most 65535, got 70000"),
        ("tcp:host:0", "at least 1, got 0"),
        ("udpin:::14540", "not of the form"),
        ("serial:", "not of the form serial"),
        ("serial::57600", "not of the form serial"),
        ("serial:/dev/ttyS0:fast", "not of the form serial"),
        ("fd:-1", "not of the form fd"),
        ("fd:", "not of the form fd"),
        ("fd:99999999999999", "not of the form fd"),
        ("udpin:127.0.0.1:١٢", "not of the form"),
    ],
)
def test_malformed_urls_say_what_is_wrong(url: str, problem: str) -> None:
    with pytest.raises(LinkError, match=problem):
        parse_endpoint(url)


@given(st.text(max_size=40), st.sampled_from(["", "udpin:", "tcp:", "serial:", "fd:", "udp://"]))
def test_any_text_parses_or_is_refused_in_one_line(text: str, prefix: str) -> None:
    try:
        endpoint = parse_endpoint(prefix + text)
    except LinkError:
        return
    assert 0 <= endpoint.port <= 65_535
    assert endpoint.url == prefix + text


@pytest.mark.parametrize(
    "url", ["udpin:0.0.0.0:0", "tcpin:0.0.0.0:0", "udpout:192.0.2.1:14550", "tcp:192.0.2.1:5760"]
)
def test_beyond_this_machine_signing_is_required(url: str) -> None:
    for opener in (open_transport, open_listener):
        with pytest.raises(LinkError, match="must be signed"):
            opener(url)


@pytest.mark.parametrize("permission", [{"signed": True}, {"allow_unsigned": True}])
def test_beyond_this_machine_with_permission(permission: dict[str, bool]) -> None:
    for opener in (open_transport, open_listener):
        opener("udpin:0.0.0.0:0", **permission).close()


def test_a_host_that_does_not_exist() -> None:
    with pytest.raises(LinkError, match="no such host"):
        open_transport("udpout:no-such-host.invalid:14550")


def test_an_address_of_another_machine_cannot_be_bound() -> None:
    with pytest.raises(LinkError, match="this machine"):
        open_transport("udpin:192.0.2.1:0", allow_unsigned=True)


def test_a_device_that_does_not_exist() -> None:
    with pytest.raises(LinkError, match="no such device"):
        open_transport("serial:/dev/no-such-device:57600")


def test_a_file_that_is_no_serial_device() -> None:
    with pytest.raises(LinkError):
        open_transport("serial:/dev/null:57600")
