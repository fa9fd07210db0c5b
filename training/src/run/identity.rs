//! What a run follows from, how it is written into run.json, and how two of them differ.

use std::collections::BTreeMap;
use std::fs;
use std::io::ErrorKind;
use std::path::Path;
use std::time::SystemTime;

use serde::{Deserialize, Serialize};
use sha2::{Digest, Sha256};

use super::RunError;
use super::difference::lines_that_differ;
use super::error::io;

/// Version of run.json.
const SCHEMA: u32 = 1;

/// All that decides about a run's weights, beside the machine's arithmetic.
#[derive(Debug, Clone, PartialEq, Eq, Default)]
pub struct RunIdentity {
    /// The configuration, verbatim.
    pub config_toml: String,
    /// Seed of all random numbers.
    pub seed: u64,
    /// Hash of the data set.
    pub fingerprint: String,
    /// Number of threads: sums are added in another order by another number.
    pub threads: usize,
    /// More that must be equal, by name: a trunk's hash, the device...
    pub details: BTreeMap<String, String>,
}

/// The content of run.json.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct RunRecord {
    /// Version of this file's layout.
    pub schema: u32,
    /// Program and version that began the run.
    pub generator: String,
    /// Seed of all random numbers.
    pub seed: u64,
    /// Hash of the data set.
    pub fingerprint: String,
    /// Number of threads.
    pub threads: usize,
    /// SHA-256 of config.toml.
    pub config_sha256: String,
    /// More that must be equal to resume.
    pub details: BTreeMap<String, String>,
    /// When the run began: UTC as `2026-11-25T08:30:00Z`.
    pub started: String,
}

impl RunRecord {
    /// The record of a run that begins now.
    pub(super) fn of(identity: &RunIdentity) -> Self {
        let now_s = SystemTime::now().duration_since(SystemTime::UNIX_EPOCH).map_or(0, |age| age.as_secs());
        Self {
            schema: SCHEMA,
            generator: generator(),
            seed: identity.seed,
            fingerprint: identity.fingerprint.clone(),
            threads: identity.threads,
            config_sha256: sha256(&identity.config_toml),
            details: identity.details.clone(),
            started: utc(now_s),
        }
    }

    /// Reads a run.json; none when there is no such file.
    pub(super) fn read(path: &Path) -> Result<Option<Self>, RunError> {
        let text = match fs::read_to_string(path) {
            Ok(text) => text,
            Err(error) if error.kind() == ErrorKind::NotFound => return Ok(None),
            Err(error) => return Err(io("read", path)(error)),
        };
        let wrong = |reason: String| RunError::Record { path: path.into(), reason };
        #[derive(Deserialize)]
        struct Schema {
            schema: u32,
        }
        let found: Schema = serde_json::from_str(&text).map_err(|error| wrong(error.to_string()))?;
        if found.schema != SCHEMA {
            let reason = format!("its schema is {}, this program knows {SCHEMA}", found.schema);
            return Err(wrong(format!("{reason}; resume with the version that began the run")));
        }
        serde_json::from_str(&text).map(Some).map_err(|error| wrong(error.to_string()))
    }

    /// Why a run of `identity` would not go on as the recorded one, whose config.toml is `config`; empty: it would.
    pub(super) fn differences(&self, config: &str, identity: &RunIdentity) -> Vec<String> {
        let mut differences = Vec::new();
        if self.generator != generator() {
            let (old, new) = (&self.generator, generator());
            differences.push(format!("- program: {old} began it, this is {new}; use {old}"));
        }
        if sha256(config) != self.config_sha256 {
            differences.push("- config.toml in the folder was edited after the run began; restore it".into());
        }
        if identity.config_toml != config {
            let lines = lines_that_differ(config, &identity.config_toml).join("\n");
            let hint = "give the run's own config.toml, or start a new run";
            differences.push(format!("- configuration (- is the run's, + what was given); {hint}:\n{lines}"));
        }
        if self.seed != identity.seed {
            let (old, new) = (self.seed, identity.seed);
            differences.push(format!("- seed: the run's is {old}, {new} was given; give {old}"));
        }
        if self.fingerprint != identity.fingerprint {
            let (old, new) = (&self.fingerprint, &identity.fingerprint);
            let hint = "give the data set that the run began with, unchanged";
            differences.push(format!(
                "- wrong data set: the run's fingerprint is {old}, that of the given one {new}; {hint}"
            ));
        }
        if self.threads != identity.threads {
            let (old, new) = (self.threads, identity.threads);
            let hint = format!("sums come out differently; run with {old} (RAYON_NUM_THREADS={old})");
            differences.push(format!("- threads: {old} began it, {new} would go on; {hint}"));
        }
        let names =
            self.details.keys().chain(identity.details.keys().filter(|n| !self.details.contains_key(*n)));
        for name in names {
            let of = |details: &BTreeMap<String, String>| details.get(name).cloned().unwrap_or("none".into());
            let (old, new) = (of(&self.details), of(&identity.details));
            if old != new {
                differences.push(format!("- {name}: the run's is {old}, now it is {new}"));
            }
        }
        differences
    }
}

fn generator() -> String {
    format!("{} {}", env!("CARGO_PKG_NAME"), env!("CARGO_PKG_VERSION"))
}

fn sha256(text: &str) -> String {
    Sha256::digest(text).iter().map(|byte| format!("{byte:02x}")).collect()
}

/// Seconds since 1970 as date and time of day (the proleptic Gregorian calendar, after Hinnant's `civil_from_days`).
fn utc(unix_s: u64) -> String {
    let (days, second) = (unix_s / 86_400 + 719_468, unix_s % 86_400);
    let (era, day_of_era) = (days / 146_097, days % 146_097);
    let year_of_era = (day_of_era - day_of_era / 1460 + day_of_era / 36_524 - day_of_era / 146_096) / 365;
    let day_of_year = day_of_era - (365 * year_of_era + year_of_era / 4 - year_of_era / 100);
    let march_month = (5 * day_of_year + 2) / 153;
    let day = day_of_year - (153 * march_month + 2) / 5 + 1;
    let month = if march_month < 10 { march_month + 3 } else { march_month - 9 };
    let year = era * 400 + year_of_era + u64::from(month <= 2);
    let (hour, minute, second) = (second / 3600, second / 60 % 60, second % 60);
    format!("{year:04}-{month:02}-{day:02}T{hour:02}:{minute:02}:{second:02}Z")
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn dates_are_those_of_the_calendar() {
        // As `date -u -d @N` says.
        let expected = [
            (0, "1970-01-01T00:00:00Z"),
            (951_782_400, "2000-02-29T00:00:00Z"),
            (1_709_251_199, "2024-02-29T23:59:59Z"),
            (1_735_689_599, "2024-12-31T23:59:59Z"),
            (4_107_542_400, "2100-03-01T00:00:00Z"),
        ];
        for (unix_s, date) in expected {
            assert_eq!(utc(unix_s), date);
        }
    }

    #[test]
    fn everything_that_differs_is_named_with_what_to_do() {
        let identity = RunIdentity {
            config_toml: "epochs = 3\nlr = 0.001\n".into(),
            seed: 7,
            fingerprint: "aa11".into(),
            threads: 2,
            details: BTreeMap::from([("trunk".into(), "cafe".into())]),
        };
        let record = RunRecord::of(&identity);
        assert_eq!(record.differences(&identity.config_toml, &identity), Vec::<String>::new());
        let other = RunIdentity {
            config_toml: "epochs = 3\nlr = 0.002\n".into(),
            seed: 8,
            fingerprint: "bb22".into(),
            threads: 4,
            details: BTreeMap::from([("device".into(), "cuda".into())]),
        };
        let text = record.differences(&identity.config_toml, &other).join("\n");
        for part in [
            "- 2: lr = 0.001",
            "+ 2: lr = 0.002",
            "the run's is 7, 8 was given",
            "wrong data set",
            "aa11",
            "bb22",
            "RAYON_NUM_THREADS=2",
            "trunk: the run's is cafe, now it is none",
            "device: the run's is none",
        ] {
            assert!(text.contains(part), "{part:?} is not in\n{text}");
        }
        assert!(!text.contains("epochs"), "{text}");
        let edited = record.differences("epochs = 4", &identity).join("\n");
        assert!(edited.contains("was edited"), "{edited}");
    }
}
