"""The benchmarks: functions that get a `Measurement` and the `Sizes`, and fill the measurement."""
