//! A node of candle's graph whose value is there already and whose gradient is a function of tensors.

use std::sync::{Mutex, PoisonError};

use candle_core::backend::BackendStorage as _;
use candle_core::{
    CpuStorage, CudaStorage, CustomOp1, CustomOp2, CustomOp3, Layout, Result, Shape, Storage, Tensor, bail,
};

/// The gradients of an operation of N inputs.
pub(super) trait Gradient<const N: usize>: Send + Sync + 'static {
    /// Name in messages.
    const NAME: &'static str;

    /// Gradients of the inputs, of the output `y` and its gradient `dy` (contiguous); none where none is wanted.
    fn gradient(&self, inputs: [&Tensor; N], y: &Tensor, dy: &Tensor) -> Result<[Option<Tensor>; N]>;
}

/// `y` as the outcome of an operation on `x` with these gradients.
pub(super) fn attach1<G: Gradient<1>>(x: &Tensor, y: Tensor, gradient: G) -> Result<Tensor> {
    if x.track_op() { x.apply_op1(Given::new(y, gradient)?) } else { Ok(y) }
}

/// As [`attach1`] for two inputs.
pub(super) fn attach2<G: Gradient<2>>(a: &Tensor, b: &Tensor, y: Tensor, gradient: G) -> Result<Tensor> {
    if a.track_op() || b.track_op() { a.apply_op2(b, Given::new(y, gradient)?) } else { Ok(y) }
}

/// As [`attach1`] for three inputs.
pub(super) fn attach3<G: Gradient<3>>([a, b, c]: [&Tensor; 3], y: Tensor, gradient: G) -> Result<Tensor> {
    let tracked = a.track_op() || b.track_op() || c.track_op();
    if tracked { a.apply_op3(b, c, Given::new(y, gradient)?) } else { Ok(y) }
}

struct Given<G> {
    /// Taken by the forward pass, so that its memory does not stay behind the copy that candle keeps.
    value: Mutex<Option<Tensor>>,
    gradient: G,
}

impl<G> Given<G> {
    fn new(value: Tensor, gradient: G) -> Result<Self> {
        Ok(Self { value: Mutex::new(Some(value.contiguous()?)), gradient })
    }

    fn take(&self, name: &str) -> Result<Tensor> {
        let value = self.value.lock().unwrap_or_else(PoisonError::into_inner).take();
        value.ok_or_else(|| candle_core::Error::Msg(format!("{name} was run twice")))
    }

    fn on_cpu(&self, name: &str) -> Result<(CpuStorage, Shape)> {
        let value = self.take(name)?;
        let (storage, layout) = value.storage_and_layout();
        match (&*storage, layout.contiguous_offsets()) {
            (Storage::Cpu(CpuStorage::F32(values)), Some((start, end))) => {
                Ok((CpuStorage::F32(values[start..end].to_vec()), layout.shape().clone()))
            }
            _ => bail!("{name} of {:?}: f32 on the CPU was expected", value),
        }
    }

    fn on_cuda(&self, name: &str) -> Result<(CudaStorage, Shape)> {
        let value = self.take(name)?;
        let (storage, layout) = value.storage_and_layout();
        match &*storage {
            // A copy is of the whole storage, which a freshly computed tensor fills.
            Storage::Cuda(cuda) if layout.start_offset() == 0 => {
                Ok((cuda.try_clone(layout)?, layout.shape().clone()))
            }
            _ => bail!("{name} of {:?}: a whole tensor on an NVIDIA GPU was expected", value),
        }
    }
}

impl<G: Gradient<1>> CustomOp1 for Given<G> {
    fn name(&self) -> &'static str {
        G::NAME
    }

    fn cpu_fwd(&self, _: &CpuStorage, _: &Layout) -> Result<(CpuStorage, Shape)> {
        self.on_cpu(G::NAME)
    }

    fn cuda_fwd(&self, _: &CudaStorage, _: &Layout) -> Result<(CudaStorage, Shape)> {
        self.on_cuda(G::NAME)
    }

    fn bwd(&self, x: &Tensor, y: &Tensor, dy: &Tensor) -> Result<Option<Tensor>> {
        let [dx] = self.gradient.gradient([x], y, &dy.contiguous()?)?;
        Ok(dx)
    }
}

impl<G: Gradient<2>> CustomOp2 for Given<G> {
    fn name(&self) -> &'static str {
        G::NAME
    }

    fn cpu_fwd(&self, _: &CpuStorage, _: &Layout, _: &CpuStorage, _: &Layout) -> Result<(CpuStorage, Shape)> {
        self.on_cpu(G::NAME)
    }

    fn cuda_fwd(
        &self,
        _: &CudaStorage,
        _: &Layout,
        _: &CudaStorage,
        _: &Layout,
    ) -> Result<(CudaStorage, Shape)> {
        self.on_cuda(G::NAME)
    }

    fn bwd(
        &self,
        a: &Tensor,
        b: &Tensor,
        y: &Tensor,
        dy: &Tensor,
    ) -> Result<(Option<Tensor>, Option<Tensor>)> {
        let [da, db] = self.gradient.gradient([a, b], y, &dy.contiguous()?)?;
        Ok((da, db))
    }
}

impl<G: Gradient<3>> CustomOp3 for Given<G> {
    fn name(&self) -> &'static str {
        G::NAME
    }

    fn cpu_fwd(
        &self,
        _: &CpuStorage,
        _: &Layout,
        _: &CpuStorage,
        _: &Layout,
        _: &CpuStorage,
        _: &Layout,
    ) -> Result<(CpuStorage, Shape)> {
        self.on_cpu(G::NAME)
    }

    fn cuda_fwd(
        &self,
        _: &CudaStorage,
        _: &Layout,
        _: &CudaStorage,
        _: &Layout,
        _: &CudaStorage,
        _: &Layout,
    ) -> Result<(CudaStorage, Shape)> {
        self.on_cuda(G::NAME)
    }

    fn bwd(
        &self,
        a: &Tensor,
        b: &Tensor,
        c: &Tensor,
        y: &Tensor,
        dy: &Tensor,
    ) -> Result<(Option<Tensor>, Option<Tensor>, Option<Tensor>)> {
        let [da, db, dc] = self.gradient.gradient([a, b, c], y, &dy.contiguous()?)?;
        Ok((da, db, dc))
    }
}
