//! Users and groups by name, from the files of the machine. Accounts that only a directory service knows are
//! shown and given by number.

use core::{fmt, str::FromStr};

/// A group of the machine.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Group {
    id: u32,
    name: Option<String>,
}

impl Group {
    /// The group with this number.
    pub fn of_id(id: u32) -> Self {
        Self { id, name: name_of(&read("/etc/group"), id) }
    }

    /// Its number.
    pub fn id(&self) -> u32 {
        self.id
    }

    /// Its name, or its number when it has none: what `chgrp` takes.
    pub fn argument(&self) -> String {
        self.name.clone().unwrap_or_else(|| self.id.to_string())
    }
}

impl fmt::Display for Group {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str(&shown(self.name.as_deref(), self.id))
    }
}

/// Not a group of this machine.
#[derive(Debug, Clone, PartialEq, Eq, thiserror::Error)]
#[error(
    "there is no group {0:?} in /etc/group; create it (`groupadd --system {0}`), or give the number of a group that only a directory service knows"
)]
pub struct UnknownGroup(String);

impl FromStr for Group {
    type Err = UnknownGroup;

    /// By name or by number.
    fn from_str(text: &str) -> Result<Self, Self::Err> {
        if let Ok(id) = text.parse() {
            return Ok(Self::of_id(id));
        }
        id_of(&read("/etc/group"), text)
            .map(|id| Self { id, name: Some(text.to_owned()) })
            .ok_or_else(|| UnknownGroup(text.to_owned()))
    }
}

/// A user for people: name and number.
pub(crate) fn user(id: u32) -> String {
    shown(name_of(&read("/etc/passwd"), id).as_deref(), id)
}

/// A user for a command line: the name, or the number when there is none.
pub(crate) fn user_argument(id: u32) -> String {
    name_of(&read("/etc/passwd"), id).unwrap_or_else(|| id.to_string())
}

fn shown(name: Option<&str>, id: u32) -> String {
    name.map_or_else(|| id.to_string(), |name| format!("{name} ({id})"))
}

/// A table that cannot be read has no names; the numbers remain.
fn read(table: &str) -> String {
    std::fs::read(table).map(|bytes| String::from_utf8_lossy(&bytes).into_owned()).unwrap_or_default()
}

/// `name:password:id:...`, one account a line.
fn accounts(table: &str) -> impl Iterator<Item = (&str, u32)> {
    table.lines().filter_map(|line| {
        let mut fields = line.split(':');
        let (name, _password, id) = (fields.next()?, fields.next()?, fields.next()?);
        Some((name, id.parse().ok()?)).filter(|(name, _)| !name.is_empty())
    })
}

fn name_of(table: &str, id: u32) -> Option<String> {
    accounts(table).find(|account| account.1 == id).map(|(name, _)| name.to_owned())
}

fn id_of(table: &str, name: &str) -> Option<u32> {
    accounts(table).find(|account| account.0 == name).map(|(_, id)| id)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn tables_are_read_both_ways() {
        let table = "root:x:0:\n# comment\nbroken:x\n+::::\ngrnet:x:998:ann,bob\n";
        assert_eq!(name_of(table, 998).as_deref(), Some("grnet"));
        assert_eq!(id_of(table, "grnet"), Some(998));
        assert_eq!(name_of(table, 5), None);
        assert_eq!(id_of(table, "broken"), None);
    }

    #[test]
    fn a_group_is_given_by_name_or_number() {
        let root: Group = "root".parse().unwrap();
        assert_eq!((root.id(), &*root.to_string(), &*root.argument()), (0, "root (0)", "root"));
        let nameless: Group = "3987654321".parse().unwrap();
        assert_eq!((nameless.id(), &*nameless.to_string()), (3_987_654_321, "3987654321"));
        let error = "no-such-group".parse::<Group>().unwrap_err().to_string();
        assert!(error.contains("groupadd --system no-such-group"), "{error}");
    }
}
