"""Damage that leaves a file readable: values changed without a checksum, lost chunks, chunks that unpack too far."""

import foreign_logs as foreign
import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest
from synthetic_logs import make_flight

from cfb_mjx.errors import CfbError
from cfb_mjx.logs import read_log, write_tabular


@pytest.fixture(scope="module")
def flight():
    return make_flight(duration=2.0, rate=100.0)


@pytest.fixture
def plain(flight, tmp_path):
    """The flight as pandas writes parquet: without checksums, values as they are."""
    write_tabular(flight, tmp_path / "ours.parquet")
    table = pq.read_table(tmp_path / "ours.parquet")
    path = tmp_path / "plain.parquet"
    pq.write_table(table, path, compression="none", use_dictionary=False)
    return path


def test_a_parquet_without_checksums_says_so(flight, plain, tmp_path):
    assert any("no checksums" in note for note in read_log(plain).metadata["notes"])
    assert "notes" not in read_log(tmp_path / "ours.parquet").metadata
    pq.write_table(pq.read_table(plain), plain, write_page_checksum=True, compression="zstd", use_dictionary=True)
    assert "notes" not in read_log(plain).metadata


def test_values_beyond_what_the_footer_notes_are_damage(flight, plain):
    data = bytearray(plain.read_bytes())
    at = data.index(np.float64(flight.velocity[50, 0]).tobytes())
    data[at : at + 8] = np.float64(30.0).tobytes()
    plain.write_bytes(data)
    with pytest.raises(CfbError, match=r"column vx holds values beyond .* the range stored by its writer"):
        read_log(plain)


def test_a_table_of_absurd_size_is_refused(tmp_path):
    path = tmp_path / "a.parquet"
    pq.write_table(pa.table({"t": pa.array(np.zeros(1 << 20, dtype=np.int8))}), path)
    import cfb_mjx.logs.tabular as tabular

    limit, tabular._MOST_CELLS = tabular._MOST_CELLS, 1 << 19
    try:
        with pytest.raises(CfbError, match="more than a flight has"):
            read_log(path)
    finally:
        tabular._MOST_CELLS = limit


@pytest.fixture
def bag(flight, tmp_path):
    names = [*foreign.STATE, *foreign.IMU, *foreign.MOTOR]
    made = foreign.Bag(doubles=True)
    made.custom("/cf231/all", flight, names)
    made.write(tmp_path / "bag.mcap", enable_crcs=False)
    foreign.write_crazyflies_yaml(tmp_path / "topics.yaml", {"all": names})
    return tmp_path / "bag.mcap", tmp_path / "topics.yaml"


def chunks(data):
    """Where the chunks (record type 6) of an MCAP begin and end."""
    position, found = 8, []
    while position + 9 <= len(data):
        length = int.from_bytes(data[position + 1 : position + 9], "little")
        if data[position] == 6:
            found.append((position, position + 9 + length))
        position += 9 + length
    return found


def test_a_bag_that_lost_a_chunk_is_noticed_against_its_own_statistics(bag):
    path, topics = bag
    assert not read_log(path, topics_yaml=topics).metadata["warnings"]
    data = path.read_bytes()
    start, stop = chunks(data)[1]
    path.write_bytes(data[:start] + data[stop:])
    log = read_log(path, topics_yaml=topics)
    assert any("that the file's own statistics count are missing" in w for w in log.metadata["warnings"])


@pytest.mark.parametrize("ours", [True, False])
def test_a_chunk_that_would_unpack_to_gigabytes_is_refused(bag, flight, tmp_path, ours):
    path, topics = bag
    options = {"topics_yaml": topics}
    if ours:
        from cfb_mjx.logs import write_mcap

        path, options = tmp_path / "ours.mcap", {}
        write_mcap(flight, path)
    data = bytearray(path.read_bytes())
    start, _ = chunks(bytes(data))[0]
    data[start + 25 : start + 33] = (1 << 34).to_bytes(8, "little")
    path.write_bytes(data)
    with pytest.raises(CfbError, match="would unpack to 16384 MiB"):
        read_log(path, **options)
