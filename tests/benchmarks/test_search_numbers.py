"""Test the count of numbers in code."""

from levid.benchmarks.trace.search_numbers import measure, numbers


def test_numbers_count_except_plain_ones() -> None:
    source = 'A = 3\nB = -1\nC = [0.5, 1e-3, 2.0, True, "7", 0]\n\ndef f(x=4.0):\n    """9"""\n'
    assert sorted(numbers(source)) == [1e-3, 3, 4.0]


def test_total_is_the_sum_of_the_packages() -> None:
    *parts, total = measure()
    assert total.value == sum(p.value or 0 for p in parts)
    assert total.value > 0
