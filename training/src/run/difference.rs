//! The lines in which two short texts differ.

/// Differing lines that are shown; of more, their number.
const SHOWN: usize = 20;
/// Lines of which a table of all pairs is made.
const COMPARED: usize = 2000;

/// Lines only in `old` as `  - 3: text`, those only in `new` as `  + 3: text`, in reading order.
pub(super) fn lines_that_differ(old: &str, new: &str) -> Vec<String> {
    let (old, new): (Vec<&str>, Vec<&str>) = (old.lines().collect(), new.lines().collect());
    if old == new {
        return vec!["  only the ends of lines differ".into()];
    }
    let same = old.iter().zip(&new).take_while(|(a, b)| a == b).count();
    let (old_rest, new_rest) = (&old[same..], &new[same..]);
    let (removed, added) = match old_rest.len().max(new_rest.len()) <= COMPARED {
        true => unmatched(old_rest, new_rest),
        false => ((0..old_rest.len()).collect(), (0..new_rest.len()).collect()),
    };
    let removed = removed.iter().map(|n| (same + n, 0, format!("  - {}: {}", same + n + 1, old_rest[*n])));
    let added = added.iter().map(|n| (same + n, 1, format!("  + {}: {}", same + n + 1, new_rest[*n])));
    let mut lines: Vec<_> = removed.chain(added).collect();
    lines.sort();
    let more = lines.len().saturating_sub(SHOWN);
    let mut lines: Vec<String> = lines.into_iter().take(SHOWN).map(|(_, _, text)| text).collect();
    if more > 0 {
        lines.push(format!("  ... and {more} more"));
    }
    lines
}

/// Indices that are not part of a longest common subsequence.
fn unmatched(old: &[&str], new: &[&str]) -> (Vec<usize>, Vec<usize>) {
    // length[i][j]: of the longest common subsequence of old[i..] and new[j..].
    let mut length = vec![vec![0_u32; new.len() + 1]; old.len() + 1];
    for i in (0..old.len()).rev() {
        for j in (0..new.len()).rev() {
            length[i][j] = match old[i] == new[j] {
                true => length[i + 1][j + 1] + 1,
                false => length[i + 1][j].max(length[i][j + 1]),
            };
        }
    }
    let (mut i, mut j) = (0, 0);
    let (mut removed, mut added) = (Vec::new(), Vec::new());
    while i < old.len() || j < new.len() {
        if i < old.len() && j < new.len() && old[i] == new[j] {
            (i, j) = (i + 1, j + 1);
        } else if j == new.len() || (i < old.len() && length[i + 1][j] >= length[i][j + 1]) {
            removed.push(i);
            i += 1;
        } else {
            added.push(j);
            j += 1;
        }
    }
    (removed, added)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn only_what_differs_is_shown() {
        assert_eq!(lines_that_differ("a\nb\nc\nd", "a\nc\nx\nd"), ["  - 2: b", "  + 3: x"]);
        assert_eq!(lines_that_differ("a", "a\nb"), ["  + 2: b"]);
        assert_eq!(lines_that_differ("", "b"), ["  + 1: b"]);
        assert_eq!(lines_that_differ("a\n", "a"), ["  only the ends of lines differ"]);
    }

    #[test]
    fn long_differences_are_cut() {
        let old: String = (0..3000).map(|n| format!("old {n}\n")).collect();
        let lines = lines_that_differ(&old, "new");
        assert_eq!((lines.len(), lines.last().unwrap().as_str()), (21, "  ... and 2981 more"));
    }
}
