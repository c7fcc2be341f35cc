"""Clips of several dialects whose joints are known, in the folder of shared motion."""

AMC_FILES = [f"cmu_asfamc/{name}.amc" for name in ("01_01", "02_01", "02_03", "03_01", "03_03")]
BVH_FILES = [
    "cmu_bvh_max/131_01.bvh",
    "cmu_bvh_max/scaled_131_01.bvh",
    "cmu_bvh_mb/cmu_12_01_walk.bvh",
    "cmu_bvh_poser/03_01.bvh",
    "mit/pybvh_test1_zup.bvh",
    "mit/full_precision_frame_time.bvh",
]
