//! Bytes of anybody: loading damaged files ends in an error or in the very same checkpoint, never in a panic.

mod common;

use std::path::Path;
use std::sync::LazyLock;

use common::tiny;
use grnet_model::{Checkpoint, Preprocessing, Storage, untrained};
use proptest::prelude::*;

static VALID: LazyLock<(Checkpoint, Vec<u8>)> = LazyLock::new(|| {
    let checkpoint = untrained::checkpoint(&tiny(), 11, Preprocessing::default()).unwrap();
    let checkpoint = checkpoint.with_storage(Storage::F16).unwrap();
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("valid");
    checkpoint.save(&path).unwrap();
    let bytes = std::fs::read(&path).unwrap();
    (checkpoint, bytes)
});

fn load(bytes: &[u8]) -> Result<Checkpoint, String> {
    Checkpoint::from_bytes(bytes, Path::new("foreign")).map_err(|error| error.to_string())
}

/// A change of the tensors must be refused; one of the metadata may be valid and then shows.
fn assert_error_or_honest(bytes: &[u8]) {
    match load(bytes) {
        Err(message) => assert!(message.contains("foreign"), "the file must be named: {message}"),
        Ok(loaded) => assert_eq!(loaded.content_hash(), VALID.0.content_hash()),
    }
}

fn header_length() -> usize {
    8 + u64::from_le_bytes(VALID.1[..8].try_into().unwrap()) as usize
}

#[test]
fn the_unharmed_bytes_load() {
    let loaded = load(&VALID.1).unwrap();
    assert_eq!(loaded.metadata(), VALID.0.metadata());
}

proptest! {
    #![proptest_config(ProptestConfig { cases: 96, failure_persistence: None, ..ProptestConfig::default() })]

    #[test]
    fn truncated_files_are_refused(length in 0usize..VALID.1.len()) {
        prop_assert!(load(&VALID.1[..length]).is_err());
    }

    #[test]
    fn changed_bytes_of_the_header_are_survived(
        changes in prop::collection::vec((any::<prop::sample::Index>(), any::<u8>()), 1..6)
    ) {
        let mut bytes = VALID.1.clone();
        for (index, byte) in changes {
            bytes[index.index(header_length())] = byte;
        }
        assert_error_or_honest(&bytes);
    }

    #[test]
    fn changed_weights_are_refused(index in any::<prop::sample::Index>(), flip in 1u8..) {
        let mut bytes = VALID.1.clone();
        let data = header_length();
        let at = data + index.index(bytes.len() - data);
        bytes[at] ^= flip;
        prop_assert!(load(&bytes).is_err());
    }

    #[test]
    fn removed_and_inserted_stretches_are_survived(
        at in any::<prop::sample::Index>(), removed in 0usize..64, inserted in prop::collection::vec(any::<u8>(), 0..64)
    ) {
        let mut bytes = VALID.1.clone();
        let start = at.index(header_length());
        bytes.splice(start..start + removed, inserted);
        assert_error_or_honest(&bytes);
    }

    #[test]
    fn changed_numbers_in_the_metadata_are_survived(nth in any::<prop::sample::Index>(), number in any::<u64>()) {
        let header = String::from_utf8(VALID.1[8..header_length()].to_vec()).unwrap();
        // The metadata is JSON within JSON; every run of digits in the whole header is fair game.
        let starts: Vec<usize> = header.char_indices().filter(|(i, c)| {
            c.is_ascii_digit() && !header[..*i].ends_with(|p: char| p.is_ascii_digit())
        }).map(|(i, _)| i).collect();
        let start = starts[nth.index(starts.len())];
        let end = start + header[start..].find(|c: char| !c.is_ascii_digit()).unwrap();
        let header = format!("{}{number}{}", &header[..start], &header[end..]);
        let mut bytes = (header.len() as u64).to_le_bytes().to_vec();
        bytes.extend(header.as_bytes());
        bytes.extend(&VALID.1[header_length()..]);
        assert_error_or_honest(&bytes);
    }

    #[test]
    fn noise_is_refused(bytes in prop::collection::vec(any::<u8>(), 0..512)) {
        prop_assert!(load(&bytes).is_err());
    }
}
