//! Names: of cameras and of the services that belong to one.

use core::{fmt, str::FromStr};

use iceoryx2::prelude::ServiceName;

/// The name of a camera: 1 to 31 of `a-z A-Z 0-9 _ - .`, starting with a letter, digit or `_`.
///
/// ```
/// use grnet_proto::CameraName;
/// assert_eq!("front".parse::<CameraName>().unwrap().to_string(), "front");
/// assert!("front camera".parse::<CameraName>().is_err());
/// ```
#[derive(Debug, Clone, PartialEq, Eq, Hash, PartialOrd, Ord)]
pub struct CameraName(String);

/// Why a text is no camera name.
#[derive(Debug, Clone, PartialEq, Eq, thiserror::Error)]
#[error(
    "{found:?} is no camera name: {problem}; use 1 to 31 of a-z A-Z 0-9 _ - . starting with a letter, digit or _"
)]
pub struct CameraNameError {
    found: String,
    problem: &'static str,
}

impl CameraName {
    /// The camera that programs mean when none is named.
    pub const DEFAULT: &'static str = "front";

    /// The longest name in bytes.
    pub const MAX_LEN: usize = 31;

    /// The name as text.
    pub fn as_str(&self) -> &str {
        &self.0
    }
}

impl Default for CameraName {
    fn default() -> Self {
        Self(Self::DEFAULT.to_owned())
    }
}

impl FromStr for CameraName {
    type Err = CameraNameError;

    fn from_str(text: &str) -> Result<Self, Self::Err> {
        let error = |problem| Err(CameraNameError { found: text.to_owned(), problem });
        let Some(first) = text.chars().next() else { return error("it is empty") };
        if text.len() > Self::MAX_LEN {
            return error("it is longer than 31 bytes");
        }
        if !(first.is_ascii_alphanumeric() || first == '_') {
            return error("its first character is not allowed there");
        }
        if !text.chars().all(|c| c.is_ascii_alphanumeric() || matches!(c, '_' | '-' | '.')) {
            return error("it contains a character that is not allowed");
        }
        Ok(Self(text.to_owned()))
    }
}

impl TryFrom<&str> for CameraName {
    type Error = CameraNameError;

    fn try_from(text: &str) -> Result<Self, Self::Error> {
        text.parse()
    }
}

impl fmt::Display for CameraName {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.pad(&self.0)
    }
}

/// Publish-subscribe and event service of the pose stream.
pub fn pose(camera: &CameraName) -> String {
    format!("grnet/{camera}/pose")
}

/// Publish-subscribe and event service of the daemon's status.
pub fn status(camera: &CameraName) -> String {
    format!("grnet/{camera}/status")
}

/// Request-response and event service for requests to the daemon.
pub fn control(camera: &CameraName) -> String {
    format!("grnet/{camera}/control")
}

/// Publish-subscribe service of the camera's images, where the daemon is configured to publish them.
pub fn image(camera: &CameraName) -> String {
    format!("grnet/{camera}/image")
}

/// A name of this module as iceoryx2's type.
pub(crate) fn service_name(name: &str) -> ServiceName {
    ServiceName::new(name).expect("a validated camera name gives a valid service name")
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn names_are_as_documented() {
        let camera = CameraName::default();
        assert_eq!(pose(&camera), "grnet/front/pose");
        assert_eq!(status(&camera), "grnet/front/status");
        assert_eq!(control(&camera), "grnet/front/control");
        assert_eq!(image(&camera), "grnet/front/image");
    }

    #[test]
    fn what_is_no_name_is_refused_with_the_reason() {
        for text in ["", "a/b", "-x", ".x", "ü", "a b", &"x".repeat(32)] {
            let error = text.parse::<CameraName>().unwrap_err().to_string();
            assert!(error.contains(&format!("{text:?}")), "{error}");
        }
        let longest = "x".repeat(31);
        assert_eq!(service_name(&pose(&longest.parse().unwrap())).as_str(), format!("grnet/{longest}/pose"));
    }
}
