//! The paper's plan with replacements. Each replaced text must occur in it.
pub const PAPER: &str = include_str!("../../../examples/paper.toml");

/// Changes for trials of a single kind.
pub const ONE_CONDITION: [(&str, &str); 4] = [
    ("cycles = 5", "cycles = 1"),
    (r#"["dry", "lubricated"]"#, r#"["dry"]"#),
    (r#"["a1", "a2", "a3", "a4", "a5"]"#, r#"["a5"]"#),
    (
        "[fold_test]\nlubrication = \"lubricated\"\nindentation = \"a5\"\nrepeats = 1\n",
        "",
    ),
];

/// `plan` with each first text replaced by the second one.
pub fn changed(plan: &str, changes: &[(&str, &str)]) -> String {
    changes.iter().fold(plan.to_owned(), |plan, (old, new)| {
        assert_eq!(plan.matches(old).count(), 1, "`{old}` in the plan");
        plan.replace(old, new)
    })
}
