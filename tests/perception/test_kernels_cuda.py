"""The kernels compile for CUDA where Warp brings its compiler, and agree with the CPU where there is a
GPU."""

import pytest
import torch
import warp as wp
from clouds import MAX_RANGE, random_rays, sample

from omniperception.perception import PdSampler, kernels
from omniperception.perception.motion_match import match_motion
from omniperception.perception.rings import write_rings
from omniperception.perception.velocity_risk import worst_sectors


@pytest.mark.parametrize("module", [kernels, match_motion.module, write_rings.module, worst_sectors.module])
def test_kernels_compile_for_cuda(module, tmp_path):
    wp.init()
    try:
        files = wp.compile_aot_module(module, arch=80, module_dir=tmp_path)
    except RuntimeError as error:
        if "CUDA" in str(error) and "compil" not in str(error).lower():
            pytest.skip(f"no CUDA compiler in this Warp: {error}")
        raise
    assert files and all(path.stat().st_size > 0 for path in files)


@pytest.mark.skipif(not torch.cuda.is_available(), reason="needs a CUDA device")
def test_cuda_equals_cpu():
    rays = random_rays(37, 500, seed=1)
    sampler = PdSampler(64, 32, max_range=MAX_RANGE, split_deg=10.0)
    on_gpu = torch.empty(37, 96, 3, device="cuda")
    sampler(*(t.cuda() for t in rays), on_gpu)
    assert torch.allclose(on_gpu.cpu(), sample(sampler, rays), atol=1e-5)
