from mavfi_cli.core.files import folder_digest, write_text


def test_what_utf_8_does_not_have_is_written_escaped(tmp_path):
    write_text(tmp_path / "crash.txt", "a corrupted name: \udc80")
    assert (tmp_path / "crash.txt").read_bytes() == rb"a corrupted name: \udc80"


def test_a_deep_digest_depends_on_settings_and_a_shallow_one_on_sources_only(tmp_path):
    def digests(value):
        folder = tmp_path / str(value)
        (folder / "stacks").mkdir(parents=True)
        (folder / "code.py").write_text("pass")
        (folder / "stacks" / "own.toml").write_text(f"gain = {value}")
        return folder_digest(folder), folder_digest(folder, deep=True)

    (shallow, deep), (same, other) = digests(1), digests(2)
    assert shallow == same
    assert deep != other
