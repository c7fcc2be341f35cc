"""What several tests share: cases, synthetic clips, experiments, finite differences."""
