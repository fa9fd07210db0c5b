//! The grnet camera-to-pose daemon
