"""What models share that query another policy server, or were trained on others' numbers.

`vla_zenoh_serve` answers as such a server, `vla_zenoh_dataset` writes such numbers. For model
environments: numpy, msgpack and what vla-zenoh itself needs are enough to import it.
"""
