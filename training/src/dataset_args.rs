//! Which recording, and how it is laid out: the arguments that several commands share.

use std::path::PathBuf;

use clap::Args;
use grnet_capture::dataset::{Layout, OpenOptions};

/// How to find the frames in a folder.
#[derive(Debug, Clone, Args)]
pub struct FrameArgs {
    /// How the folder is laid out.
    #[arg(long, value_enum, default_value_t = LayoutName::Auto)]
    pub layout: LayoutName,
    /// The one sequence to take, as `seq-01` or `06` [default: all].
    #[arg(long, value_name = "NAME")]
    pub sequence: Option<String>,
    /// The camera to take where there are several, as `image_2` or `cam1`.
    #[arg(long, value_name = "NAME")]
    pub camera: Option<String>,
}

/// How to read a recording with its ground truth.
#[derive(Debug, Clone, Args)]
pub struct DatasetArgs {
    /// How the folder is read.
    #[command(flatten)]
    pub frames: FrameArgs,
    /// Ground truth of the camera instead of the layout's own: TUM, EuRoC or KITTI text.
    #[arg(long, value_name = "FILE")]
    pub poses: Option<PathBuf>,
    /// Regular time stamps at this rate instead of the recorded ones.
    #[arg(long, value_name = "HZ")]
    pub rate: Option<f64>,
}

/// Layouts by name.
#[derive(Debug, Clone, Copy, PartialEq, Eq, clap::ValueEnum, serde::Deserialize)]
#[serde(rename_all = "lowercase")]
pub enum LayoutName {
    /// Found out from the folder's content.
    Auto,
    /// Microsoft 7-Scenes.
    #[value(name = "7scenes")]
    #[serde(rename = "7scenes")]
    SevenScenes,
    /// KITTI odometry.
    Kitti,
    /// TUM RGB-D.
    Tum,
    /// EuRoC/ASL.
    Euroc,
    /// COLMAP model with its images.
    Colmap,
    /// A folder of images.
    Images,
}

impl From<LayoutName> for Layout {
    fn from(name: LayoutName) -> Self {
        match name {
            LayoutName::Auto => Self::Auto,
            LayoutName::SevenScenes => Self::SevenScenes,
            LayoutName::Kitti => Self::Kitti,
            LayoutName::Tum => Self::Tum,
            LayoutName::Euroc => Self::Euroc,
            LayoutName::Colmap => Self::Colmap,
            LayoutName::Images => Self::Images,
        }
    }
}

impl FrameArgs {
    /// As the dataset readers take them.
    pub fn open_options(&self) -> OpenOptions {
        OpenOptions {
            layout: self.layout.into(),
            sequence: self.sequence.clone(),
            camera_name: self.camera.clone(),
            ..OpenOptions::default()
        }
    }
}

impl DatasetArgs {
    /// As the dataset readers take them.
    pub fn open_options(&self) -> OpenOptions {
        OpenOptions { poses: self.poses.clone(), rate_hz: self.rate, ..self.frames.open_options() }
    }
}
