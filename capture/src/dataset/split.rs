//! Lists that choose a part of the frames.

use std::collections::{HashMap, HashSet};
use std::path::{Path, PathBuf};

use super::listing::{Set, names};
use super::pose_table::key_of;
use super::seven_scenes::{names_sequence, split_file};
use super::text::{TextFile, quoted};
use super::{DatasetError, Layout, Split};

/// Keeps the frames that the split chooses; sequences without any are dropped.
pub(crate) fn apply(set: &mut Set, split: &Split) -> Result<(), DatasetError> {
    let file = match split {
        Split::All => return Ok(()),
        Split::Train => official(set, "TrainSplit.txt")?,
        Split::Test => official(set, "TestSplit.txt")?,
        Split::List(path) => TextFile::read(&locate(path, &set.root))?,
    };
    keep(set, &file)
}

fn official(set: &Set, name: &str) -> Result<TextFile, DatasetError> {
    match set.layout {
        Layout::SevenScenes => split_file(&set.root, name),
        layout => Err(DatasetError::no_option("split", layout, "give a list file instead")),
    }
}

/// The file itself, or the one of that name in the recording's folder.
pub(crate) fn locate(path: &Path, root: &Path) -> PathBuf {
    if path.exists() { path.to_path_buf() } else { root.join(path) }
}

fn keep(set: &mut Set, file: &TextFile) -> Result<(), DatasetError> {
    let mut by_key = HashMap::new();
    for (sequence, listing) in set.listings.iter().enumerate() {
        for (index, frame) in listing.frames.iter().enumerate() {
            by_key.insert(frame.key.as_str(), (sequence, index));
        }
    }
    let mut kept = HashSet::new();
    let mut lines = 0;
    for line in file.data_lines() {
        lines += 1;
        let whole = set.listings.iter().position(|listing| names_sequence(line.text, &listing.id));
        let chosen: Vec<_> = match (whole, by_key.get(key_of(line.text).as_str())) {
            (Some(sequence), _) => {
                (0..set.listings[sequence].frames.len()).map(|index| (sequence, index)).collect()
            }
            (None, Some(&frame)) => vec![frame],
            (None, None) if is_of_another(set, line.text) => continue,
            (None, None) => {
                let ids = names(set.listings.iter().map(|listing| listing.id.as_str()));
                let expected = format!("a sequence ({ids}) or a frame such as {}", quoted(&example(set)));
                return Err(line.unexpected(expected));
            }
        };
        for frame in chosen {
            if !kept.insert(frame) {
                return Err(line.error(format!("{} again", quoted(line.text)), "each frame once"));
            }
        }
    }
    if kept.is_empty() {
        return Err(DatasetError::Empty {
            path: file.path().to_path_buf(),
            expected: format!(
                "its {lines} lines choose none of {}",
                names(set.listings.iter().map(|listing| listing.name.as_str()))
            ),
        });
    }
    for (sequence, listing) in set.listings.iter_mut().enumerate() {
        let mut index = 0;
        listing.frames.retain(|_| {
            index += 1;
            kept.contains(&(sequence, index - 1))
        });
    }
    set.listings.retain(|listing| !listing.frames.is_empty());
    Ok(())
}

/// Whether a line speaks of a sequence that is known but not listed here.
fn is_of_another(set: &Set, line: &str) -> bool {
    let sequence = line.split('/').next().unwrap_or_default();
    set.others.iter().any(|other| names_sequence(sequence, other))
}

fn example(set: &Set) -> String {
    set.listings.iter().flat_map(|listing| &listing.frames).next().map_or_else(String::new, |f| f.key.clone())
}
