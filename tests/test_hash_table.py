import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from triquad_server.hash_table import HashTable

KEYS = st.lists(st.integers(0, 2**42), unique=True, max_size=400)


@settings(max_examples=30, deadline=None)
@given(KEYS, KEYS)
def test_it_answers_as_a_dictionary_does(first: list[int], second: list[int]) -> None:
    table = HashTable(torch.device("cpu"))
    expected: dict[int, int] = {}
    for keys in (first, [key for key in second if key not in set(first)]):
        rows = range(len(expected) + 1, len(expected) + 1 + len(keys))
        expected.update(zip(keys, rows, strict=True))
        table.insert(torch.tensor(keys, dtype=torch.int64), torch.tensor(list(rows)).long())
    asked = torch.tensor([*first, *second, 7, 2**43], dtype=torch.int64)
    assert table.lookup(asked).tolist() == [expected.get(int(key), 0) for key in asked]
    keys, rows = table.items()
    assert dict(zip(keys.tolist(), rows.tolist(), strict=True)) == expected
    assert keys.tolist() == sorted(expected)


def test_keys_that_share_a_home_are_all_found() -> None:
    table = HashTable(torch.device("cpu"))
    keys = torch.arange(200_000, dtype=torch.int64)
    table.insert(keys, keys + 1)
    assert torch.equal(table.lookup(keys), keys + 1)
    assert len(table) == 200_000


def test_a_copy_does_not_see_later_keys() -> None:
    table = HashTable(torch.device("cpu"))
    table.insert(torch.tensor([3]), torch.tensor([1]))
    twin = table.copy()
    table.insert(torch.tensor([4]), torch.tensor([2]))
    assert twin.lookup(torch.tensor([3, 4])).tolist() == [1, 0]
