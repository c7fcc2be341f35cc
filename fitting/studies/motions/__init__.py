"""Whole skeletons of what studies are about, for run folders and pages."""
