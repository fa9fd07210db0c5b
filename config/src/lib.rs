//! Typed configuration of grnetd
