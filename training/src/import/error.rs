//! Why public weights could not be taken over.

use std::path::PathBuf;

/// Why public weights could not be taken over.
#[derive(Debug, thiserror::Error)]
pub enum ImportError {
    /// The network is not ResNet-50 at full size.
    #[error(
        "public ResNet-50 weights do not fit a network with {field} = {found}; they need {needed} (preset `grnet` has it)"
    )]
    Network {
        /// The field of the network's configuration.
        field: &'static str,
        /// Its value.
        found: String,
        /// The value that fits.
        needed: &'static str,
    },
    /// The file system refused.
    #[error("cannot read the weights {}", path.display())]
    Io {
        /// The file.
        path: PathBuf,
        /// What the system says.
        #[source]
        source: std::io::Error,
    },
    /// A PyTorch file, which is a program as much as data.
    #[error(
        "{} is a PyTorch pickle, which is not read here; save its state_dict with `safetensors.torch.save_file` and name \
         that file",
        path.display()
    )]
    Pickle {
        /// The file.
        path: PathBuf,
    },
    /// Not a safetensors file, or one that was cut off.
    #[error("{} is no complete safetensors file", path.display())]
    NotSafetensors {
        /// The file.
        path: PathBuf,
        /// What is wrong with it.
        #[source]
        source: safetensors::SafeTensorError,
    },
    /// The tensors are those of something else.
    #[error("{} does not hold a plain ResNet-50 as torchvision and timm name it: {problems}", path.display())]
    Layout {
        /// The file.
        path: PathBuf,
        /// Missing, surplus and misshapen tensors by name, found against expected.
        problems: String,
    },
    /// An element type that is not read.
    #[error("tensor {tensor} of {} is {found}; F32, F16 and BF16 are read", path.display())]
    ElementType {
        /// The file.
        path: PathBuf,
        /// The tensor.
        tensor: String,
        /// Its element type.
        found: String,
    },
    /// A weight is NaN or infinite, or a variance negative.
    #[error("tensor {tensor} of {} holds {found}; {expected} expected", path.display())]
    Value {
        /// The file.
        path: PathBuf,
        /// The tensor.
        tensor: String,
        /// The value.
        found: f32,
        /// What it must be.
        expected: &'static str,
    },
    /// A tensor could not be made.
    #[error("cannot make the tensors of the network from {}", path.display())]
    Tensor {
        /// The file.
        path: PathBuf,
        /// What candle says.
        #[source]
        source: candle_core::Error,
    },
    /// Neither a file nor the address of one.
    #[error(
        "--init {init:?} cannot be used: {problem}; name a safetensors file, or `hf:owner/repository[@revision][/file]`"
    )]
    Address {
        /// As given.
        init: String,
        /// What is wrong with it.
        problem: String,
    },
    /// This build cannot download.
    #[error(
        "--init {init:?} needs a download, and this build has none: build with `--features hf-hub`, or download the file \
         another way and pass its path (`{download}`)"
    )]
    NoDownload {
        /// As given.
        init: String,
        /// A command that fetches the file.
        download: String,
    },
    /// The hub did not give the file.
    #[cfg(feature = "hf-hub")]
    #[error(
        "cannot fetch {file} of {repository} at {revision} from the hub; check the names and the network, or download the \
         file another way and pass its path"
    )]
    Hub {
        /// owner/name.
        repository: String,
        /// Branch, tag or commit.
        revision: String,
        /// The file in it.
        file: String,
        /// What the hub's client says.
        #[source]
        source: Box<hf_hub::api::sync::ApiError>,
    },
}
