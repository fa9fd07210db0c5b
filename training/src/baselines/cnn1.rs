//! Retrieval by the features of a checkpoint's CNN1: what the network's own eyes are worth without its regression.

use std::path::Path;
use std::sync::Arc;

use grnet_capture::decode;
use grnet_frame::{CaptureTime, Frame};
use grnet_model::LoadedModel;
use grnet_model::candle_core::Tensor;
use grnet_pipeline::IntrinsicsOptions;
use grnet_pipeline::preprocess::{InputSpec, Preprocessor};

use super::retrieval::{self, normalise};
use super::{BaselineError, ImageError, Predictions, Progress, Task};

/// Retrieval by [`describe`].
///
/// # Errors
/// When there are no training frames, or a training image cannot be described.
pub fn predict(
    model: &LoadedModel,
    task: &Task,
    progress: Progress<'_>,
) -> Result<Predictions, BaselineError> {
    retrieval::predict("CNN1 features", task, |path| describe(model, path), progress)
}

/// CNN1's features of an image, averaged over its area, of unit norm.
///
/// # Errors
/// When the image cannot be read, or the network fails on it.
pub fn describe(model: &LoadedModel, path: &Path) -> Result<Vec<f32>, ImageError> {
    let config = model.network.config();
    let (height_px, width_px) = (config.input_height_px, config.input_width_px);
    let spec = InputSpec {
        size_px: (width_px as u32, height_px as u32),
        preprocessing: model.metadata.preprocessing.clone(),
        // Training and test images come from one camera: whatever its view, it is the same for both.
        trained_camera: None,
    };
    let network = |error: &dyn std::fmt::Display| ImageError::Network(error.to_string());
    let mut preprocessor =
        Preprocessor::new(spec, IntrinsicsOptions::default(), None).map_err(|e| network(&e))?;
    let frame = Frame {
        pixels: Arc::new(decode::decode_file(path)?),
        capture_time: CaptureTime::recorded(0),
        sequence: 0,
        camera: None,
    };
    let input = preprocessor.run(&frame).map_err(|e| network(&e))?;
    let image = Tensor::from_slice(input, (1, 3, height_px, width_px), model.network.device())
        .map_err(|e| network(&e))?;
    let features = model.network.features(&image).map_err(|e| network(&e))?;
    // (1, C, h, w) -> (C)
    let pooled = features.mean((2, 3)).and_then(|t| t.squeeze(0)).and_then(|t| t.to_vec1::<f32>());
    let mut values = pooled.map_err(|e| network(&e))?;
    normalise(&mut values);
    Ok(values)
}

#[cfg(test)]
mod tests {
    use super::super::retrieval::dot;
    use super::*;
    use grnet_model::NetworkConfig;

    #[test]
    fn features_tell_images_apart_and_repeat() {
        let folder = tempfile::tempdir().unwrap();
        let write = |name: &str, colour: &dyn Fn(u32, u32) -> [u8; 3]| {
            let path = folder.path().join(name);
            image::RgbImage::from_fn(64, 48, |x, y| image::Rgb(colour(x, y))).save(&path).unwrap();
            path
        };
        let config = NetworkConfig {
            width: 0.125,
            input_height_px: 48,
            input_width_px: 64,
            ..NetworkConfig::grnet_small()
        };
        let model = LoadedModel::untrained(&config, 1).unwrap();
        let a = describe(&model, &write("a.png", &|x, y| [(x * 4) as u8, (y * 5) as u8, 0])).unwrap();
        let b = describe(&model, &write("b.png", &|x, y| [0, ((x ^ y) * 3) as u8, 255])).unwrap();
        assert_eq!(a.len(), config.features_shape().0);
        assert!((dot(&a, &a) - 1.0).abs() < 1e-5);
        assert!(dot(&a, &b) < 0.9999);
        assert_eq!(a, describe(&model, &folder.path().join("a.png")).unwrap());
        assert!(describe(&model, &folder.path().join("c.png")).is_err());
    }
}
