//! The contract of `FrameSource` as a test suite.
