"""The experiment file as JSON Schema, made from what reads it. Start with `experiment_schema`."""
