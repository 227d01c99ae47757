"""The kernels compile for CUDA where Warp brings its compiler, and agree with the CPU where there is a
GPU."""

import pytest
import torch
import warp as wp
from clouds import MAX_RANGE, random_rays, sample

from omnilidar import SectorDistances
from omnilidar.kernels.sectors import sector_minima
from omniperception.avoidance.kernels import worst_sectors
from omniperception.perception import FpsSampler, PdSampler, standing_kernels
from omniperception.perception.networks.kernels import write_rings
from omniperception.perception.samplers import kernels, sorting_kernels

MODULES = [kernels, sorting_kernels, standing_kernels, *(k.module for k in (write_rings, worst_sectors, sector_minima))]


@pytest.mark.parametrize("module", MODULES)
def test_kernels_compile_for_cuda(module, tmp_path):
    wp.init()
    try:
        files = wp.compile_aot_module(module, arch=80, module_dir=tmp_path)
    except RuntimeError as error:
        if "CUDA" in str(error) and "compil" not in str(error).lower():
            pytest.skip(f"no CUDA compiler in this Warp: {error}")
        raise
    assert files and all(path.stat().st_size > 0 for path in files)


SAMPLERS = [PdSampler(64, 32, max_range=MAX_RANGE, split_deg=10.0), FpsSampler(70, max_range=MAX_RANGE)]


@pytest.mark.gpu
@pytest.mark.skipif(not torch.cuda.is_available(), reason="needs a CUDA device")
@pytest.mark.parametrize("sampler", SAMPLERS)
@pytest.mark.parametrize("num_rays", [1, 500, 20_000])
def test_cuda_samples_what_the_cpu_does(sampler, num_rays):
    rays = random_rays(37, num_rays, seed=1)
    on_gpu = torch.empty(37, sampler.num_points, 3, device="cuda")
    sampler(*(t.cuda() for t in rays), on_gpu)
    same = ((on_gpu.cpu() - sample(sampler, rays)).abs() < 1e-5).flatten(1).all(1)
    assert same.float().mean() > 0.9  # which point is the farthest can hang on the last bit


@pytest.mark.gpu
@pytest.mark.skipif(not torch.cuda.is_available(), reason="needs a CUDA device")
def test_cuda_measures_the_sectors_that_the_cpu_does():
    ranges, directions, _, _ = random_rays(37, 500, seed=2)
    classes = torch.randint(-1, 3, ranges.shape, dtype=torch.int32)
    upright = (1.0, 0.0, 0.0, 0.0)
    given = {"mount_pos": (0.3, 0.0, 0.0), "mount_quat": upright, "obstacle_class": 2, "max_distance": 6.0}
    pose = torch.zeros(37, 1, 3), torch.tensor([[upright]]).repeat(37, 1, 1)
    tensors = (ranges, directions, classes, *pose)
    on_gpu = SectorDistances(*(t.cuda() for t in tensors), base=0, **given)()
    assert torch.allclose(on_gpu.cpu(), SectorDistances(*tensors, base=0, **given)(), atol=1e-5)
