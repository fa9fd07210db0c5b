//! Opening an NVIDIA GPU for a network (feature `cuda`).
//!
//! All work of one device belongs on one thread: candle gives each thread a queue of its own on the GPU, and two queues do
//! not wait for each other.

use candle_core::{Device, Result};

/// The GPU of that index, in the driver's order.
///
/// # Errors
/// When there is none, the driver refuses, or this build has no feature `cuda`.
pub fn cuda(index: usize) -> Result<Device> {
    let device = Device::new_cuda(index)?;
    #[cfg(feature = "cuda")]
    gpu::keep_memory(device.as_cuda_device()?);
    Ok(device)
}

/// Lets matrix products in f32 round their factors to 10 bits (TF32), as PyTorch does by default in convolutions: several
/// times faster on a GPU that has it. Holds for the whole process, and for nothing but GPUs.
pub fn allow_tf32(allowed: bool) {
    #[cfg(feature = "cuda")]
    candle_core::cuda_backend::set_gemm_reduced_precision_f32(allowed);
    #[cfg(not(feature = "cuda"))]
    let _ = allowed;
}

/// Name and memory of a GPU for people; none for the CPU.
pub fn describe(device: &Device) -> Option<String> {
    #[cfg(feature = "cuda")]
    if let Ok(cuda) = device.as_cuda_device() {
        return gpu::describe(cuda);
    }
    let _ = device;
    None
}

/// Memory of a GPU that is not free, in MiB; none for the CPU.
pub fn used_mib(device: &Device) -> Option<usize> {
    #[cfg(feature = "cuda")]
    if let Ok(cuda) = device.as_cuda_device() {
        let (free, total) = cuda.cuda_stream().context().mem_get_info().ok()?;
        return Some((total - free) >> 20);
    }
    let _ = device;
    None
}

#[cfg(feature = "cuda")]
mod gpu {
    #![allow(unsafe_code, reason = "cudarc offers the attributes of memory pools as bare driver calls only")]

    use candle_core::CudaDevice;
    use candle_core::cuda_backend::cudarc::driver::{result, sys};

    pub(super) fn describe(device: &CudaDevice) -> Option<String> {
        let stream = device.cuda_stream();
        let context = stream.context();
        let (free, total) = context.mem_get_info().ok()?;
        let gib = |bytes: usize| bytes as f64 / (1u64 << 30) as f64;
        Some(format!("{}, {:.1} of {:.1} GiB free", context.name().ok()?, gib(free), gib(total)))
    }

    /// Keeps freed memory for the next step. By default the driver takes it back whenever the host waits for the GPU, and
    /// mapping it again costs more than the step's arithmetic. A driver that refuses is slower, not wrong.
    pub(super) fn keep_memory(device: &CudaDevice) {
        let context = device.cuda_stream().context().clone();
        if !context.has_async_alloc() {
            return;
        }
        // SAFETY: the device is that of a live context, which this function holds.
        let pool = unsafe { result::device::get_default_mem_pool(context.cu_device()) };
        if let Ok(pool) = pool {
            let threshold = sys::CUmemPool_attribute::CU_MEMPOOL_ATTR_RELEASE_THRESHOLD;
            let mut all = u64::MAX;
            // SAFETY: the pool lives as long as its device, and the driver reads one u64 for this attribute, which outlives
            // the call.
            let _ = unsafe { result::mem_pool::set_attribute(pool, threshold, (&raw mut all).cast()) };
        }
    }
}
