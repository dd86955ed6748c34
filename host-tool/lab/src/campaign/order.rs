//! The order of the trials. Settings that need manual work at the rig form blocks: an indentation is set once for all
//! its trials, and dry comes before lubricated. The plan's seed shuffles the rest: the blocks of one group (series,
//! fold test) with equal lubrication, and the trials within a block.

use std::collections::BTreeMap;

use serde::{Deserialize, Serialize};

use crate::campaign::chance::Chance;
use crate::campaign::form::Form;
use crate::campaign::plan::{CampaignPlan, Lubrication, TrialPurpose};

#[derive(Clone, Debug, PartialEq, Eq, PartialOrd, Ord, Hash, Serialize, Deserialize)]
pub struct Condition {
    pub purpose: TrialPurpose,
    pub lubrication: Lubrication,
    pub indentation: String,
    pub shape: Form,
}

/// A row of `order.csv`: a planned trial.
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub struct Planned {
    /// Number from 1, in the order of execution.
    pub trial: u32,
    /// Number of the block, from 1. The rollers are clamped again at the start of each block.
    pub block: u32,
    pub purpose: TrialPurpose,
    pub lubrication: Lubrication,
    pub indentation: String,
    pub shape: Form,
    /// Number of the repeat of its condition, from 1.
    pub repeat: u32,
}

impl Planned {
    pub fn condition(&self) -> Condition {
        Condition {
            purpose: self.purpose,
            lubrication: self.lubrication,
            indentation: self.indentation.clone(),
            shape: self.shape,
        }
    }
}

/// All trials of a plan, in the order that its seed gives.
pub fn order(plan: &CampaignPlan) -> Vec<Planned> {
    let mut chance = Chance::new(plan.seed);
    let mut trials = vec![];
    let mut block = 0;
    for group in &plan.groups {
        let mut indentations = group.indentations.clone();
        chance.shuffle(&mut indentations);
        for indentation in indentations {
            block += 1;
            let mut kinds: Vec<_> = group
                .kinds
                .iter()
                .flat_map(|kind| std::iter::repeat_n(*kind, group.repeats as usize))
                .collect();
            chance.shuffle(&mut kinds);
            let mut done = BTreeMap::new();
            for (purpose, shape) in kinds {
                let repeat = done.entry((purpose, shape)).or_insert(0);
                *repeat += 1;
                trials.push(Planned {
                    trial: trials.len() as u32 + 1,
                    block,
                    purpose,
                    lubrication: group.lubrication,
                    indentation: indentation.clone(),
                    shape,
                    repeat: *repeat,
                });
            }
        }
    }
    trials
}
