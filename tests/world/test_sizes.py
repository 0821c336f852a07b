from fsmsm_jax.world.sizes import bucket


def test_buckets_are_few_and_waste_little():
    sizes = range(1, 20_000)
    buckets = [bucket(size) for size in sizes]
    assert buckets == sorted(buckets)
    for size, room in zip(sizes, buckets, strict=True):
        assert size <= room < size + max(size / 8, 8)
        assert bucket(room) == room
    for power in (64, 128, 1024, 8192):
        assert len({bucket(size) for size in range(power + 1, 2 * power + 1)}) == 8
