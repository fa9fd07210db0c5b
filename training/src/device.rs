//! Where networks are computed: `--device`, and the recipe's `device`.

use std::fmt;
use std::str::FromStr;

use candle_core::Device;
use grnet_model::device;

/// A device by name: `cpu`, `cuda` or `cuda:N`.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default, serde::Deserialize)]
#[serde(try_from = "String")]
pub enum DeviceName {
    /// The processor.
    #[default]
    Cpu,
    /// The NVIDIA GPU of this index.
    Cuda(usize),
}

/// A device that cannot be used.
#[derive(Debug, thiserror::Error)]
pub enum DeviceError {
    /// Not a device's name.
    #[error("\"{found}\" names no device; use \"cpu\", \"cuda\" or \"cuda:N\"")]
    Name {
        /// What was given.
        found: String,
    },
    /// The program was built without CUDA.
    #[error(
        "this grnet-train was built without CUDA and cannot use {name}; build it with `cargo build --release -p grnet-train \
         --features cuda` where NVIDIA's CUDA tool kit is installed (docs/training.md, \"On a GPU\")"
    )]
    NotBuilt {
        /// The device.
        name: DeviceName,
    },
    /// TF32 was asked of the processor.
    #[error(
        "--tf32 is about an NVIDIA GPU, and this would compute on the CPU; add --device cuda, or leave it out"
    )]
    Tf32OnCpu,
    /// The driver refuses.
    #[error("cannot use {name}; `nvidia-smi` lists the GPUs that the driver sees")]
    Open {
        /// The device.
        name: DeviceName,
        /// What the driver says.
        #[source]
        source: candle_core::Error,
    },
}

/// The arguments that choose a device.
#[derive(Debug, Clone, Copy, Default, clap::Args)]
pub struct DeviceArgs {
    /// Where to compute: cpu, cuda or cuda:N; a GPU needs a build with feature `cuda` [default: the recipe's, else cpu].
    #[arg(long, value_name = "DEVICE")]
    pub device: Option<DeviceName>,
    /// Let a GPU round the factors of matrix products to 10 bits (TF32): faster, less exact.
    #[arg(long)]
    pub tf32: bool,
}

impl DeviceName {
    /// Opens it.
    ///
    /// # Errors
    /// When this build or this machine does not have it.
    pub fn open(self) -> Result<Device, DeviceError> {
        match self {
            Self::Cpu => Ok(Device::Cpu),
            Self::Cuda(_) if !cfg!(feature = "cuda") => Err(DeviceError::NotBuilt { name: self }),
            Self::Cuda(index) => {
                device::cuda(index).map_err(|source| DeviceError::Open { name: self, source })
            }
        }
    }
}

impl DeviceArgs {
    /// Opens the device, or `otherwise` where none was given, and says which GPU it is.
    ///
    /// # Errors
    /// As [`DeviceName::open`].
    pub fn open(&self, otherwise: DeviceName, tf32: bool) -> Result<(DeviceName, Device), DeviceError> {
        let name = self.device.unwrap_or(otherwise);
        if self.tf32 && name == DeviceName::Cpu {
            return Err(DeviceError::Tf32OnCpu);
        }
        let opened = name.open()?;
        device::allow_tf32(self.tf32 || tf32);
        if let Some(about) = device::describe(&opened) {
            let precision = if self.tf32 || tf32 { "TF32" } else { "exact" };
            eprintln!("{name}: {about}; f32 matrix products: {precision}");
        }
        Ok((name, opened))
    }
}

impl FromStr for DeviceName {
    type Err = DeviceError;

    fn from_str(text: &str) -> Result<Self, DeviceError> {
        let refused = || DeviceError::Name { found: text.to_owned() };
        match text.split_once(':') {
            None if text == "cpu" => Ok(Self::Cpu),
            None if text == "cuda" => Ok(Self::Cuda(0)),
            Some(("cuda", index)) => index.parse().map(Self::Cuda).map_err(|_| refused()),
            _ => Err(refused()),
        }
    }
}

impl TryFrom<String> for DeviceName {
    type Error = DeviceError;

    fn try_from(text: String) -> Result<Self, DeviceError> {
        text.parse()
    }
}

impl fmt::Display for DeviceName {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match self {
            Self::Cpu => f.write_str("cpu"),
            Self::Cuda(index) => write!(f, "cuda:{index}"),
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn names_go_there_and_back() {
        for (text, device) in
            [("cpu", DeviceName::Cpu), ("cuda", DeviceName::Cuda(0)), ("cuda:3", DeviceName::Cuda(3))]
        {
            assert_eq!(text.parse::<DeviceName>().unwrap(), device);
            assert_eq!(device.to_string().parse::<DeviceName>().unwrap(), device);
        }
        for text in ["", "gpu", "cuda:", "cuda:-1", "cpu:0", "CUDA"] {
            let error = text.parse::<DeviceName>().unwrap_err().to_string();
            assert!(error.contains(&format!("\"{text}\"")), "{error}");
        }
    }

    #[test]
    fn tf32_is_refused_on_the_cpu_and_a_recipes_waits_for_a_gpu() {
        let args = |tf32| DeviceArgs { device: None, tf32 };
        let error = args(true).open(DeviceName::Cpu, false).unwrap_err().to_string();
        assert!(error.contains("--tf32") && error.contains("--device cuda"), "{error}");
        assert_eq!(args(false).open(DeviceName::Cpu, true).unwrap().0, DeviceName::Cpu);
    }

    #[cfg(not(feature = "cuda"))]
    #[test]
    fn a_build_without_cuda_says_how_to_get_one() {
        let error = DeviceName::Cuda(0).open().unwrap_err().to_string();
        assert!(error.contains("cuda:0") && error.contains("--features cuda"), "{error}");
    }
}
